//! What is being watched: each picture is drawn once for all who watch the same.
//!
//! Viewers of one environment in one style are a group. Its task looks at the session, has the picture drawn and puts it where
//! every viewer of the group finds the latest; then it waits as long as its fastest viewer does. A viewer that is slow to read
//! finds a later picture next time: nobody waits for it, and nothing is kept for it.
//!
//! Invariants: viewers, of a session and in all, stay within the limits; a group lives as long as somebody is in it; a look at a
//! session is asked for only once the last one is drawn.

use super::painter::{Drawn, Painter, Style};
use crate::{
    batch::{BatchError, Moment},
    config::Config,
    grpc::{host::Host, status::CallError},
    sessions::{Glance, SessionError, SessionId, Viewer, Wish},
};
use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};
use tokio::{
    sync::{Notify, oneshot, watch},
    time::sleep_until,
};

/// How often a group between two looks makes sure that the session is there.
const PRESENCE: Duration = Duration::from_secs(1);

/// What a group watches, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Subject {
    pub session: SessionId,
    pub index: usize,
    pub style: Style,
}

/// A picture and when it was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    pub moment: Moment,
    pub drawn: Drawn,
}

/// What a group has to show.
#[derive(Debug, Clone, Default)]
pub enum Shown {
    /// The session was never reset.
    #[default]
    Nothing,
    /// The latest picture.
    Frame(Arc<Frame>),
    /// There will be no more.
    Over(Result<(), CallError>),
}

/// All viewers of a server.
#[derive(Debug, Default)]
pub struct Gallery(Mutex<Inner>);

#[derive(Debug, Default)]
struct Inner {
    groups: HashMap<Subject, Arc<Group>>,
    /// Viewers of each session that has some.
    viewers: HashMap<SessionId, usize>,
    total: usize,
    /// Started for the first viewer.
    painter: Option<Arc<Painter>>,
}

#[derive(Debug)]
struct Group {
    latest: watch::Sender<Shown>,
    /// Pauses between pictures that its viewers want.
    pauses: Mutex<Vec<Duration>>,
    /// Somebody came who may want pictures sooner.
    joined: Notify,
}

impl Group {
    fn pauses(&self) -> MutexGuard<'_, Vec<Duration>> {
        self.pauses.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn shortest_pause(&self) -> Duration {
        self.pauses().iter().min().copied().unwrap_or_default()
    }
}

/// A viewer's place in a group; given back when dropped.
pub struct Place {
    host: Arc<Host>,
    subject: Subject,
    pause: Duration,
    group: Arc<Group>,
    pub latest: watch::Receiver<Shown>,
}

impl Gallery {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets a viewer in who wants pictures that far apart.
    pub fn enter(host: &Arc<Host>, subject: Subject, pause: Duration) -> Result<Place, CallError> {
        let Config { max_viewers, max_viewers_per_session, .. } = host.config;
        let limit = |what, limit: usize, asked: usize| {
            if asked <= limit {
                return Ok(());
            }
            Err(CallError::Limit { field: "viewers", what, limit: limit as u64, asked: asked as u64 })
        };
        let mut inner = host.gallery.lock();
        let of_session = inner.viewers.get(&subject.session).copied().unwrap_or_default();
        limit("viewers of a session", max_viewers_per_session, of_session + 1)?;
        limit("viewers on this server", max_viewers, inner.total + 1)?;
        let painter = match &inner.painter {
            Some(painter) => Arc::clone(painter),
            None => Arc::clone(inner.painter.insert(Arc::new(Painter::start()?))),
        };
        inner.total += 1;
        *inner.viewers.entry(subject.session).or_default() += 1;
        let (group, latest) = if let Some(group) = inner.groups.get(&subject) {
            (Arc::clone(group), group.latest.subscribe())
        } else {
            let (sender, latest) = watch::channel(Shown::Nothing);
            let group = Arc::new(Group { latest: sender, pauses: Mutex::default(), joined: Notify::new() });
            inner.groups.insert(subject, Arc::clone(&group));
            tokio::spawn(show(Arc::clone(host), subject, Arc::clone(&group), painter));
            (group, latest)
        };
        group.pauses().push(pause);
        group.joined.notify_one();
        Ok(Place { host: Arc::clone(host), subject, pause, group, latest })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut inner = self.host.gallery.lock();
        inner.total -= 1;
        if let Some(of_session) = inner.viewers.get_mut(&self.subject.session) {
            *of_session -= 1;
            if *of_session == 0 {
                inner.viewers.remove(&self.subject.session);
            }
        }
        let mut pauses = self.group.pauses();
        if let Some(at) = pauses.iter().position(|pause| *pause == self.pause) {
            pauses.swap_remove(at);
        }
        // Its task ends by itself; who comes from now on finds another.
        if pauses.is_empty() && inner.groups.get(&self.subject).is_some_and(|group| Arc::ptr_eq(group, &self.group)) {
            inner.groups.remove(&self.subject);
        }
    }
}

/// Shows a group what there is, until nobody watches or nothing is left to see.
async fn show(host: Arc<Host>, subject: Subject, group: Arc<Group>, painter: Arc<Painter>) {
    let outcome = tokio::select! {
        outcome = look_and_draw(&host, subject, &group, &painter) => outcome,
        () = group.latest.closed() => Ok(()),
        () = host.shutdown.cancelled() => Err(CallError::ShuttingDown),
    };
    let mut inner = host.gallery.lock();
    if inner.groups.get(&subject).is_some_and(|known| Arc::ptr_eq(known, &group)) {
        inner.groups.remove(&subject);
    }
    drop(inner);
    group.latest.send_replace(Shown::Over(outcome));
}

async fn look_and_draw(host: &Host, subject: Subject, group: &Group, painter: &Painter) -> Result<(), CallError> {
    let mut seen = None;
    loop {
        let (eye, sight) = oneshot::channel();
        let wish = Wish { index: subject.index, seen, viewer: Box::new(Eye(eye)) };
        match host.sessions.look(subject.session, Instant::now(), wish) {
            Ok(()) => {}
            // The first look says that there is no such session, a later one that it has ended.
            Err(SessionError::Unknown | SessionError::Expired) if seen.is_some() => return Ok(()),
            Err(error) => return Err(error.into()),
        }
        let Ok(glance) = sight.await else { return Ok(()) };
        let (glance, looked) = (glance?, Instant::now());
        let drawn = painter.draw(glance.picture, subject.style).await?;
        let (len, limit) = (drawn.content.len(), host.config.max_message_bytes);
        if len > limit {
            let what = "bytes in a picture";
            return Err(CallError::Limit { field: "max_width", what, limit: limit as u64, asked: len as u64 });
        }
        seen = Some(glance.moment.changes);
        group.latest.send_replace(Shown::Frame(Arc::new(Frame { moment: glance.moment, drawn })));
        loop {
            let (due, now) = (looked + group.shortest_pause(), Instant::now());
            if due <= now {
                break;
            }
            // Without a wish nobody says that the session has ended.
            tokio::select! {
                () = sleep_until(due.min(now + PRESENCE).into()) => {}
                () = group.joined.notified() => {}
            }
            if !host.sessions.contains(subject.session) {
                return Ok(());
            }
        }
    }
}

/// A group's eye.
struct Eye(oneshot::Sender<Result<Glance, BatchError>>);

impl Viewer for Eye {
    fn has_gone(&self) -> bool {
        self.0.is_closed()
    }

    fn see(self: Box<Self>, glance: Result<Glance, BatchError>) {
        // Whoever waited may have gone this very moment.
        let _ = self.0.send(glance);
    }
}
