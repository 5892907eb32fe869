use super::*;
use crate::{
    batch::{Autoreset, BatchOptions, SimBatch},
    sim::maze,
};

const SECOND: Duration = Duration::from_secs(1);

fn sessions() -> Arc<Sessions> {
    Arc::new(Sessions::new(Limits {
        max_sessions: 3,
        max_envs_per_session: 10,
        max_total_envs: 15,
        default_lease: 10 * SECOND,
        max_lease: 60 * SECOND,
    }))
}

fn batch(num_envs: usize) -> Box<dyn Batch> {
    let maze = maze::configure(&serde_json::Map::new()).unwrap();
    let options = BatchOptions { num_envs, autoreset: Autoreset::NextStep, max_episode_steps: 0, action_masks: false };
    Box::new(SimBatch::new(maze, options))
}

fn create(sessions: &Sessions, num_envs: usize, now: Instant) -> Result<SessionId, SessionError> {
    sessions.create(&Holder::anybody(), num_envs, None, now, || batch(num_envs)).map(|(id, _)| id)
}

#[test]
fn limits_hold_before_anything_is_made() {
    let (sessions, now) = (sessions(), Instant::now());
    let never = || -> Box<dyn Batch> { panic!("made in spite of the limit") };
    let limit = |error| match error {
        SessionError::Limit { field, what, limit, asked, .. } => (field, what, limit, asked),
        other => panic!("{other:?}"),
    };
    let error = sessions.create(&Holder::anybody(), 11, None, now, never).unwrap_err();
    assert_eq!(limit(error), ("num_envs", "environments in a session", 10, 11));
    create(&sessions, 10, now).unwrap();
    let error = sessions.create(&Holder::anybody(), 6, None, now, never).unwrap_err();
    // What is there is nobody's business but its holder's.
    assert_eq!(error.to_string(), "expected at most 15 environments on this server, asked for 6 more");
    assert_eq!(limit(error), ("num_envs", "environments on this server", 15, 6));
    create(&sessions, 1, now).unwrap();
    let third = create(&sessions, 1, now).unwrap();
    let error = sessions.create(&Holder::anybody(), 1, None, now, never).unwrap_err();
    assert_eq!(limit(error), ("sessions", "sessions on this server", 3, 1));
    sessions.take(third, "", now, None).unwrap().close();
    create(&sessions, 1, now).unwrap();
}

#[test]
fn a_lease_lies_within_its_bounds() {
    let (sessions, now) = (sessions(), Instant::now());
    for wrong in [Duration::ZERO, 61 * SECOND] {
        let error = sessions.create(&Holder::anybody(), 1, Some(wrong), now, || batch(1)).unwrap_err();
        assert!(matches!(error, SessionError::Lease { .. }), "{error:?}");
    }
    assert_eq!(sessions.create(&Holder::anybody(), 1, Some(60 * SECOND), now, || batch(1)).unwrap().1, 60 * SECOND);
}

#[test]
fn one_caller_at_a_time() {
    let (sessions, now) = (sessions(), Instant::now());
    let id = create(&sessions, 1, now).unwrap();
    let guard = sessions.take(id, "", now, Some(Arc::new(7_u32))).unwrap();
    assert_eq!(sessions.take(id, "", now, None).unwrap_err(), SessionError::Busy);
    let owner = sessions.owner(id).and_then(|owner| owner.downcast::<u32>().ok());
    assert_eq!(owner.as_deref(), Some(&7));
    drop(guard);
    assert!(sessions.owner(id).is_none());
    sessions.take(id, "", now, None).unwrap();
}

#[test]
fn an_idle_session_expires_and_one_in_use_does_not() {
    let (sessions, now) = (sessions(), Instant::now());
    let (idle, used) = (create(&sessions, 1, now).unwrap(), create(&sessions, 10, now).unwrap());
    let guard = sessions.take(used, "", now, None).unwrap();
    assert_eq!(sessions.next_expiry(), Some(now + 10 * SECOND));
    assert_eq!(sessions.reap(now + 9 * SECOND), 0);
    assert_eq!(sessions.reap(now + 10 * SECOND), 1);
    assert_eq!(sessions.take(idle, "", now, None).unwrap_err(), SessionError::Expired);
    drop(guard);
    // Put back, it has a whole lease again.
    assert_eq!(sessions.reap(now + 9 * SECOND), 0);
    assert_eq!(sessions.len(), 1);
}

#[test]
fn an_expired_session_is_gone_before_the_reaper_comes() {
    let (sessions, now) = (sessions(), Instant::now());
    let id = create(&sessions, 10, now).unwrap();
    assert_eq!(sessions.take(id, "", now + 11 * SECOND, None).unwrap_err(), SessionError::Expired);
    create(&sessions, 10, now).expect("its environments are free");
}

#[test]
fn an_expiring_owner_ends_its_session() {
    let (sessions, now) = (sessions(), Instant::now());
    let id = create(&sessions, 10, now).unwrap();
    sessions.take(id, "", now, None).unwrap().expire();
    assert_eq!(sessions.take(id, "", now, None).unwrap_err(), SessionError::Expired);
    assert!(sessions.is_empty());
    create(&sessions, 10, now).expect("its environments are free");
}

#[test]
fn a_panic_in_a_step_ends_the_session_and_no_other() {
    let (sessions, now) = (sessions(), Instant::now());
    let (broken, other) = (create(&sessions, 1, now).unwrap(), create(&sessions, 1, now).unwrap());
    let taker = Arc::clone(&sessions);
    let outcome = std::thread::spawn(move || {
        let _guard = taker.take(broken, "", now, None).unwrap();
        panic!("a defect");
    });
    assert!(outcome.join().is_err());
    assert_eq!(sessions.take(broken, "", now, None).unwrap_err(), SessionError::Unknown);
    sessions.take(other, "", now, None).unwrap();
}

#[test]
fn a_panic_in_the_making_gives_its_share_back() {
    let (sessions, now) = (sessions(), Instant::now());
    let maker = Arc::clone(&sessions);
    assert!(
        std::thread::spawn(move || maker.create(&Holder::anybody(), 10, None, now, || panic!("a defect")))
            .join()
            .is_err()
    );
    assert!(sessions.is_empty());
    create(&sessions, 10, now).expect("its environments are free");
}

#[test]
fn ids_are_random_and_read_back() {
    let (sessions, now) = (sessions(), Instant::now());
    let (a, b) = (create(&sessions, 1, now).unwrap(), create(&sessions, 1, now).unwrap());
    assert_ne!(a, b);
    assert_eq!(SessionId::parse(&a.to_string()), Some(a));
    assert_eq!(a.to_string().len(), 32);
    assert!(!format!("{a:?}").contains(&a.to_string()), "a log must not give the session away");
    for wrong in ["", "0", "+0000000000000000000000000000000", &a.to_string().to_uppercase().replace('0', "G")] {
        assert_eq!(SessionId::parse(wrong), None, "{wrong:?}");
    }
    assert_eq!(sessions.take(SessionId(0), "", now, None).unwrap_err(), SessionError::Unknown);
}

#[test]
fn to_another_holder_a_session_is_as_one_that_never_was() {
    let (sessions, now) = (sessions(), Instant::now());
    let holder = |name: &str| Holder { name: name.into(), ..Holder::anybody() };
    let (id, _) = sessions.create(&holder("alice"), 1, None, now, || batch(1)).unwrap();
    assert_eq!(sessions.take(id, "bob", now, None).unwrap_err(), SessionError::Unknown);
    assert_eq!(sessions.take(id, "", now, None).unwrap_err(), SessionError::Unknown);
    let guard = sessions.take(id, "alice", now, None).unwrap();
    // Not even that it is in use, or that it was.
    assert_eq!(sessions.take(id, "bob", now, None).unwrap_err(), SessionError::Unknown);
    guard.expire();
    assert_eq!(sessions.take(id, "bob", now, None).unwrap_err(), SessionError::Unknown);
    assert_eq!(sessions.take(id, "alice", now, None).unwrap_err(), SessionError::Expired);
}

#[test]
fn a_holder_has_its_quota_and_others_have_theirs() {
    let (sessions, now) = (sessions(), Instant::now());
    let alice = Holder { name: "alice".into(), max_sessions: Some(1), max_envs: Some(4) };
    let what = |error| match error {
        SessionError::Limit { field, what, limit, asked, shared: false } => (field, what, limit, asked),
        other => panic!("{other:?}"),
    };
    let error = sessions.create(&alice, 5, None, now, || batch(5)).unwrap_err();
    assert_eq!(what(error), ("num_envs", "environments of this caller", 4, 5));
    let (id, _) = sessions.create(&alice, 3, None, now, || batch(3)).unwrap();
    let error = sessions.create(&alice, 1, None, now, || batch(1)).unwrap_err();
    assert_eq!(what(error), ("sessions", "sessions of this caller", 1, 2));
    let bob = Holder { name: "bob".into(), max_sessions: None, max_envs: Some(4) };
    sessions.create(&bob, 2, None, now, || batch(2)).unwrap();
    let error = sessions.create(&bob, 3, None, now, || batch(3)).unwrap_err();
    assert_eq!(what(error), ("num_envs", "environments of this caller", 4, 5));
    // What has ended counts no more.
    sessions.take(id, "alice", now, None).unwrap().close();
    sessions.create(&alice, 4, None, now, || batch(4)).unwrap();
    assert_eq!(sessions.reap(now + 60 * SECOND), 2);
    assert!(sessions.lock().held.is_empty());
}
