//! From messages to what the learner works with. Nothing unchecked passes.

use super::status::CallError;
use crate::{
    config::Limits,
    store::{Arrays, Collection, FieldError, Filter, Recording, check_label, check_model_id, clip},
};
use base64::{Engine as _, prelude::BASE64_URL_SAFE_NO_PAD};
use mazeway_proto::learner as pb;
use sha2::{Digest as _, Sha256};
use uuid::Uuid;

/// Fewest characters of a fit's id that stand for it.
const MIN_FIT_PREFIX: usize = 8;

/// The trajectories of one request.
pub fn recordings(request: pb::RecordTrajectoriesRequest, limits: &Limits) -> Result<Vec<Recording>, CallError> {
    let (limit, got) = (limits.max_trajectories_per_request, request.trajectories.len());
    if got == 0 {
        return Err(CallError::field("trajectories", "expected at least one, got none"));
    }
    if got > limit {
        let field = "trajectories".into();
        return Err(CallError::Limit { field, what: "trajectories", limit: limit as u64, got: got as u64 });
    }
    let check = |(i, trajectory): (usize, pb::Trajectory)| {
        let (limit, got) = (limits.max_steps_per_trajectory, trajectory.states.len() / 4);
        if got > limit {
            let field = format!("trajectories[{i}].states");
            return Err(CallError::Limit { field, what: "steps", limit: limit as u64, got: got as u64 });
        }
        Ok(recording(trajectory).map_err(|error| error.within(format_args!("trajectories[{i}]")))?)
    };
    request.trajectories.into_iter().enumerate().map(check).collect()
}

fn recording(message: pb::Trajectory) -> Result<Recording, FieldError> {
    let id = uuid("trajectory_id", &message.trajectory_id)?;
    let collection = Collection {
        env_id: message.env_id,
        model_id: message.model_id,
        style: message.style,
        source: message.source,
        n_states: message.n_states,
        n_actions: message.n_actions,
    };
    let arrays = Arrays {
        states: message.states,
        actions: message.actions,
        rewards: message.rewards,
        final_state: message.final_state,
        terminated: message.terminated,
        truncated: message.truncated,
    };
    Recording::new(id, collection, message.seed, arrays)
}

/// A UUID in its usual form: 36 characters with hyphens.
fn uuid(field: &str, text: &str) -> Result<Uuid, FieldError> {
    let parsed = if text.len() == 36 { Uuid::try_parse(text).ok() } else { None };
    parsed.ok_or_else(|| {
        let message = format!("expected a UUID such as \"67e55044-10b1-426f-9247-bb680e5fe0c8\", got {:?}", clip(text));
        FieldError::new(field, message)
    })
}

/// A filter; a missing one selects everything.
pub fn filter(message: Option<pb::TrajectoryFilter>) -> Result<Filter, FieldError> {
    let Some(message) = message else { return Ok(Filter::default()) };
    let within = |error: FieldError| error.within("filter");
    let ids = message.trajectory_ids.iter().enumerate();
    let ids = ids.map(|(i, id)| uuid(&format!("trajectory_ids[{i}]"), id)).collect::<Result<_, _>>().map_err(within)?;
    for (field, label) in [("env_id", &message.env_id), ("style", &message.style), ("source", &message.source)] {
        check_label(field, label, true).map_err(within)?;
    }
    check_model_id("model_id", &message.model_id).map_err(within)?;
    Ok(Filter {
        ids,
        env_id: message.env_id,
        style: message.style,
        model_id: message.model_id,
        source: message.source,
        min_seed: message.min_seed,
        max_seed: message.max_seed,
        min_steps: message.min_steps,
        recorded_from_us: message.recorded_from.map(|t| micros("recorded_from", t)).transpose().map_err(within)?,
        recorded_until_us: message.recorded_until.map(|t| micros("recorded_until", t)).transpose().map_err(within)?,
    })
}

/// The first stored time, in microseconds, that is not before this one.
fn micros(field: &str, time: prost_types::Timestamp) -> Result<i64, FieldError> {
    let wrong = || FieldError::new(field, format!("expected a timestamp, got {} s {} ns", time.seconds, time.nanos));
    if !(0..1_000_000_000).contains(&time.nanos) {
        return Err(wrong());
    }
    let us = time.seconds.checked_mul(1_000_000).ok_or_else(wrong)?;
    us.checked_add(i64::from(time.nanos + 999) / 1000).ok_or_else(wrong)
}

/// The size of a page: `default` where none is asked for.
pub fn page_size(asked: u32, default: u32, limit: u32) -> Result<u32, FieldError> {
    match asked {
        0 => Ok(default),
        size if size <= limit => Ok(size),
        size => Err(FieldError::new("page_size", format!("expected at most {limit}, got {size}"))),
    }
}

/// What a page token belongs to: the same list under the same filter.
pub fn page_scope(list: &str, filter: &impl prost::Message) -> [u8; 8] {
    let hash = Sha256::new().chain_update(list).chain_update(filter.encode_to_vec()).finalize();
    std::array::from_fn(|i| hash[i])
}

/// A token for the page behind the row `seq`.
pub fn page_token(seq: i64, scope: [u8; 8]) -> String {
    BASE64_URL_SAFE_NO_PAD.encode([seq.to_be_bytes(), scope].concat())
}

/// The row behind which a page begins; `None` where it is the first page.
pub fn page_start(token: &str, scope: [u8; 8]) -> Result<Option<i64>, FieldError> {
    if token.is_empty() {
        return Ok(None);
    }
    let wrong = |what: &str| FieldError::new("page_token", format!("expected a token of this list, got {what}"));
    let bytes = BASE64_URL_SAFE_NO_PAD.decode(token).map_err(|_| wrong(&format!("{:?}", clip(token))))?;
    let bytes: [u8; 16] = bytes.try_into().map_err(|_| wrong(&format!("{:?}", clip(token))))?;
    let (seq, theirs) = bytes.split_at(8);
    if theirs != scope {
        return Err(wrong("that of another list or filter"));
    }
    Ok(Some(i64::from_be_bytes(std::array::from_fn(|i| seq[i]))))
}

/// The beginning of a fit's id.
pub fn fit_prefix(text: &str) -> Result<String, FieldError> {
    let usual = text.bytes().all(|b| b.is_ascii_hexdigit() || b == b'-');
    if !usual || text.len() < MIN_FIT_PREFIX || text.len() > 36 {
        let message =
            format!("expected a fit's id or its first {MIN_FIT_PREFIX} or more characters, got {:?}", clip(text));
        return Err(FieldError::new("fit_id", message));
    }
    Ok(text.to_ascii_lowercase())
}

/// As [`fit_prefix`], or nothing.
pub fn optional_fit_prefix(text: &str) -> Result<Option<String>, FieldError> {
    if text.is_empty() { Ok(None) } else { fit_prefix(text).map(Some) }
}

/// A fit's whole id.
pub fn fit_id(text: &str) -> Result<String, FieldError> {
    Ok(uuid("fit_id", text)?.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_between_two_microseconds_is_rounded_to_the_later() {
        let us = |seconds, nanos| micros("t", prost_types::Timestamp { seconds, nanos });
        assert_eq!(us(1, 0).unwrap(), 1_000_000);
        assert_eq!(us(1, 1).unwrap(), 1_000_001);
        assert_eq!(us(1, 999_999_001).unwrap(), 2_000_000);
        assert_eq!(us(-1, 500).unwrap(), -999_999);
        assert_eq!(us(1, -1).unwrap_err().field, "t");
        assert_eq!(us(i64::MAX, 0).unwrap_err().field, "t");
    }

    #[test]
    fn a_page_token_belongs_to_its_list_and_filter() {
        let filter = |style: &str| pb::TrajectoryFilter { style: style.into(), ..Default::default() };
        let scope = page_scope("trajectories", &filter("a"));
        let token = page_token(42, scope);
        assert_eq!(page_start(&token, scope).unwrap(), Some(42));
        assert_eq!(page_start("", scope).unwrap(), None);
        let others = [page_scope("trajectories", &filter("b")), page_scope("fits", &filter("a"))];
        for other in others {
            assert_eq!(page_start(&token, other).unwrap_err().field, "page_token");
        }
        for wrong in ["x", "not base64 !", "AAAA", &token[1..]] {
            assert_eq!(page_start(wrong, scope).unwrap_err().field, "page_token", "{wrong}");
        }
    }

    #[test]
    fn fits_are_named_by_eight_characters_or_more() {
        assert_eq!(fit_prefix("ABCDEF01").unwrap(), "abcdef01");
        for wrong in ["", "abcdef0", "abcdefg1", "abcdef0%", &"a".repeat(37)] {
            assert_eq!(fit_prefix(wrong).unwrap_err().field, "fit_id", "{wrong}");
        }
        assert!(fit_id("67e55044").is_err());
    }
}
