//! A trajectory as it is stored: checked, packed, with where it came from.
//!
//! Invariants of a [`Recording`]: at least one step; as many actions as states, or none and then two states at least; indices within the sizes; rewards as
//! many as steps, or none, and finite. Arrays stay packed from the wire to the disk: they are checked, never copied.

use crate::trajectory::Trajectory;
use bytes::Bytes;
use mazeway_proto::learner as pb;
use sha2::{Digest, Sha256};
use uuid::Uuid;

/// Bytes of a label at most.
pub const MAX_LABEL_BYTES: usize = 200;

/// What many recordings have in common.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct Collection {
    /// Environment or process, not empty.
    pub env_id: String,
    /// Model that describes it; empty where none is known.
    pub model_id: String,
    /// What the demonstrator was after, not empty.
    pub style: String,
    /// Who acted; may be empty.
    pub source: String,
    /// Size of the state set.
    pub n_states: u32,
    /// Size of the action set.
    pub n_actions: u32,
}

/// A trajectory's arrays, packed little-endian, and how it ended.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Arrays {
    /// State before each step, 32-bit integers, shape (steps,).
    pub states: Bytes,
    /// Action of each step, 32-bit integers, shape (steps,); empty where only the states were seen.
    pub actions: Bytes,
    /// Reward of each step, IEEE 754 doubles, shape (steps,) or empty.
    pub rewards: Bytes,
    /// State after the last step, where known.
    pub final_state: Option<u32>,
    /// The episode came to an end of its own.
    pub terminated: bool,
    /// The episode was cut off.
    pub truncated: bool,
}

/// A field that does not hold what it should.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct FieldError {
    /// Name of the field.
    pub field: String,
    /// What was expected and what came.
    pub message: String,
}

impl FieldError {
    /// An error in `field`.
    pub fn new(field: impl Into<String>, message: impl Into<String>) -> Self {
        Self { field: field.into(), message: message.into() }
    }

    /// The same error seen from the message that holds the field.
    #[must_use]
    pub fn within(self, parent: impl std::fmt::Display) -> Self {
        Self { field: format!("{parent}.{}", self.field), message: self.message }
    }
}

/// A trajectory to store, or stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recording {
    id: Uuid,
    collection: Collection,
    seed: Option<u64>,
    arrays: Arrays,
}

impl Recording {
    /// Checks everything and keeps it.
    ///
    /// # Errors
    /// The first field that breaks an invariant.
    pub fn new(id: Uuid, collection: Collection, seed: Option<u64>, arrays: Arrays) -> Result<Self, FieldError> {
        let Collection { env_id, model_id, style, source, n_states, n_actions } = &collection;
        check_label("env_id", env_id, false)?;
        check_label("style", style, false)?;
        check_label("source", source, true)?;
        check_model_id("model_id", model_id)?;
        for (field, size) in [("n_states", *n_states), ("n_actions", *n_actions)] {
            if size == 0 || size > i32::MAX as u32 {
                return Err(FieldError::new(field, format!("expected 1 to {}, got {size}", i32::MAX)));
            }
        }
        let steps = arrays.states.len() / 4;
        if steps == 0 || !arrays.states.len().is_multiple_of(4) {
            let message = format!("expected 4 bytes a step and at least one step, got {} bytes", arrays.states.len());
            return Err(FieldError::new("states", message));
        }
        if arrays.actions.is_empty() && steps == 1 && arrays.final_state.is_none() {
            let message = "expected at least two states, the final one included, where there are no actions; got one";
            return Err(FieldError::new("states", message));
        }
        if !arrays.actions.is_empty() && arrays.actions.len() != arrays.states.len() {
            let (expected, got) = (arrays.states.len(), arrays.actions.len());
            let message = format!("expected {expected} bytes for {steps} steps, or none, got {got}");
            return Err(FieldError::new("actions", message));
        }
        check_indices("states", &arrays.states, *n_states)?;
        check_indices("actions", &arrays.actions, *n_actions)?;
        if !arrays.rewards.is_empty() {
            if arrays.rewards.len() != steps * 8 {
                let (expected, got) = (steps * 8, arrays.rewards.len());
                let message = format!("expected {expected} bytes for {steps} steps, or none, got {got}");
                return Err(FieldError::new("rewards", message));
            }
            if let Some((step, reward)) = unpack_f64(&arrays.rewards).enumerate().find(|(_, r)| !r.is_finite()) {
                return Err(FieldError::new(
                    "rewards",
                    format!("expected finite rewards, got {reward} at step {step}"),
                ));
            }
        }
        if let Some(state) = arrays.final_state.filter(|state| state >= n_states) {
            return Err(FieldError::new("final_state", format!("expected a state below {n_states}, got {state}")));
        }
        Ok(Self { id, collection, seed, arrays })
    }

    /// Puts stored parts together again; they were checked when they were stored.
    pub(super) fn from_stored(id: Uuid, collection: Collection, seed: Option<u64>, arrays: Arrays) -> Self {
        Self { id, collection, seed, arrays }
    }

    /// Made by the client.
    pub fn id(&self) -> Uuid {
        self.id
    }

    /// What it has in common with others.
    pub fn collection(&self) -> &Collection {
        &self.collection
    }

    /// Seed of the episode where the source is scripted.
    pub fn seed(&self) -> Option<u64> {
        self.seed
    }

    /// The packed arrays.
    pub fn arrays(&self) -> &Arrays {
        &self.arrays
    }

    /// The parts, for those who pass them on.
    pub fn into_parts(self) -> (Uuid, Collection, Option<u64>, Arrays) {
        (self.id, self.collection, self.seed, self.arrays)
    }

    /// False where only the states were seen.
    pub fn has_actions(&self) -> bool {
        !self.arrays.actions.is_empty()
    }

    /// Number of steps; without actions the number of transitions.
    pub fn steps(&self) -> u32 {
        let states = (self.arrays.states.len() / 4) as u32;
        if self.has_actions() || self.arrays.final_state.is_some() { states } else { states - 1 }
    }

    /// Bytes of the arrays, for limits.
    pub fn packed_bytes(&self) -> usize {
        self.arrays.states.len() + self.arrays.actions.len() + self.arrays.rewards.len()
    }

    /// Unpacked, for the mathematics.
    pub fn trajectory(&self) -> Result<Trajectory, crate::trajectory::TrajectoryError> {
        if !self.has_actions() {
            let states = unpack_u32(&self.arrays.states).collect();
            return Trajectory::states_only(states, self.arrays.final_state, self.collection.n_states);
        }
        Trajectory::new(
            unpack_u32(&self.arrays.states).collect(),
            unpack_u32(&self.arrays.actions).collect(),
            self.arrays.final_state,
            self.collection.n_states,
            self.collection.n_actions,
        )
    }

    /// SHA-256 over everything but the id: two recordings of one id are the same where these agree.
    pub fn content_hash(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        let c = &self.collection;
        for text in [&c.env_id, &c.model_id, &c.style, &c.source] {
            hash.update((text.len() as u64).to_le_bytes());
            hash.update(text.as_bytes());
        }
        hash.update(c.n_states.to_le_bytes());
        hash.update(c.n_actions.to_le_bytes());
        hash.update([u8::from(self.seed.is_some())]);
        hash.update(self.seed.unwrap_or(0).to_le_bytes());
        let a = &self.arrays;
        for array in [&a.states, &a.actions, &a.rewards] {
            hash.update((array.len() as u64).to_le_bytes());
            hash.update(array);
        }
        hash.update([u8::from(a.final_state.is_some()), u8::from(a.terminated), u8::from(a.truncated)]);
        hash.update(a.final_state.unwrap_or(0).to_le_bytes());
        hash.finalize().into()
    }
}

/// A label is short and, unless it may be missing, not empty.
pub fn check_label(field: &str, label: &str, may_be_empty: bool) -> Result<(), FieldError> {
    if label.is_empty() && !may_be_empty {
        return Err(FieldError::new(field, "expected a label, got an empty string"));
    }
    if label.len() > MAX_LABEL_BYTES {
        let message = format!("expected at most {MAX_LABEL_BYTES} bytes, got {}", label.len());
        return Err(FieldError::new(field, message));
    }
    Ok(())
}

/// A model's id is empty or a SHA-256 in lower-case hexadecimal.
pub fn check_model_id(field: &str, model_id: &str) -> Result<(), FieldError> {
    let hexadecimal = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    if model_id.is_empty() || (model_id.len() == 64 && model_id.bytes().all(hexadecimal)) {
        return Ok(());
    }
    Err(FieldError::new(field, format!("expected 64 lower-case hexadecimal digits, got {:?}", clip(model_id))))
}

/// The beginning of a text from outside, for messages.
pub fn clip(text: &str) -> String {
    if text.chars().count() <= 80 { text.to_owned() } else { text.chars().take(77).chain("...".chars()).collect() }
}

/// Every index is at least 0 and below `size`.
fn check_indices(field: &str, packed: &[u8], size: u32) -> Result<(), FieldError> {
    match unpack_u32(packed).enumerate().find(|&(_, index)| index >= size) {
        None => Ok(()),
        Some((step, index)) => {
            Err(FieldError::new(field, format!("expected 0 to {}, got {} at step {step}", size - 1, index as i32)))
        }
    }
}

/// 32-bit integers of a packed array.
pub fn unpack_u32(packed: &[u8]) -> impl ExactSizeIterator<Item = u32> + '_ {
    packed.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

/// Doubles of a packed array.
pub fn unpack_f64(packed: &[u8]) -> impl ExactSizeIterator<Item = f64> + '_ {
    packed.chunks_exact(8).map(|b| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
}

/// Packs 32-bit integers.
pub fn pack_u32(values: &[u32]) -> Bytes {
    values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into()
}

/// Packs doubles.
pub fn pack_f64(values: &[f64]) -> Bytes {
    values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into()
}

impl From<Recording> for pb::Trajectory {
    /// As it goes over the wire.
    fn from(recording: Recording) -> Self {
        let (id, collection, seed, arrays) = recording.into_parts();
        Self {
            trajectory_id: id.to_string(),
            env_id: collection.env_id,
            model_id: collection.model_id,
            style: collection.style,
            source: collection.source,
            seed,
            n_states: collection.n_states,
            n_actions: collection.n_actions,
            states: arrays.states,
            actions: arrays.actions,
            rewards: arrays.rewards,
            final_state: arrays.final_state,
            terminated: arrays.terminated,
            truncated: arrays.truncated,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Breaks an invariant.
    type Break = fn(&mut Collection, &mut Arrays);

    fn parts() -> (Uuid, Collection, Option<u64>, Arrays) {
        let collection = Collection {
            env_id: "Maze-v0".into(),
            style: "goals".into(),
            source: "test".into(),
            n_states: 5,
            n_actions: 2,
            ..Collection::default()
        };
        let arrays = Arrays {
            states: pack_u32(&[0, 4, 2]),
            actions: pack_u32(&[1, 0, 1]),
            rewards: pack_f64(&[0.0, 1.0, -0.5]),
            final_state: Some(3),
            ..Arrays::default()
        };
        (Uuid::from_u128(7), collection, Some(u64::MAX), arrays)
    }

    #[test]
    fn each_broken_invariant_names_its_field() {
        let cases: [(&str, Break); 14] = [
            ("env_id", |c, _| c.env_id.clear()),
            ("env_id", |c, _| c.env_id = "x".repeat(201)),
            ("style", |c, _| c.style.clear()),
            ("source", |c, _| c.source = "x".repeat(201)),
            ("model_id", |c, _| c.model_id = "A".repeat(64)),
            ("n_states", |c, _| c.n_states = 0),
            ("n_actions", |c, _| c.n_actions = u32::MAX),
            ("states", |_, a| a.states = Bytes::new()),
            ("states", |_, a| a.states = pack_u32(&[0, 5, 1])),
            ("states", |_, a| a.states = pack_u32(&[0, -1_i32 as u32, 1])),
            ("actions", |_, a| a.actions = pack_u32(&[0])),
            ("actions", |_, a| a.actions = pack_u32(&[0, 2, 0])),
            ("rewards", |_, a| a.rewards = pack_f64(&[0.0, f64::NAN, 1.0])),
            ("final_state", |_, a| a.final_state = Some(5)),
        ];
        for (field, change) in cases {
            let (id, mut collection, seed, mut arrays) = parts();
            change(&mut collection, &mut arrays);
            let error = Recording::new(id, collection, seed, arrays).unwrap_err();
            assert_eq!(error.field, field, "{error}");
        }
    }

    #[test]
    fn states_alone_are_a_recording() {
        let (id, collection, seed, arrays) = parts();
        let alone = |states: &[u32], final_state| {
            let states = Arrays { states: pack_u32(states), final_state, ..Arrays::default() };
            Recording::new(id, collection.clone(), seed, states)
        };
        let with = alone(&[0, 4], Some(2)).expect("a recording");
        let without = alone(&[0, 4, 2], None).expect("a recording");
        assert_eq!((with.steps(), without.steps()), (2, 2));
        assert_eq!(with.trajectory(), without.trajectory());
        assert!(!with.has_actions() && with.trajectory().is_ok_and(|t| !t.has_actions()));
        assert_eq!(alone(&[0], None).expect_err("no step").field, "states");
        assert!(Recording::new(id, collection.clone(), seed, arrays).expect("a recording").has_actions());
    }

    #[test]
    fn the_content_hash_sees_every_field_but_the_id() {
        let (id, collection, seed, arrays) = parts();
        let first = Recording::new(id, collection.clone(), seed, arrays.clone()).unwrap();
        let other_id = Recording::new(Uuid::from_u128(8), collection.clone(), seed, arrays.clone()).unwrap();
        assert_eq!(first.content_hash(), other_id.content_hash());
        let mut hashes = vec![first.content_hash()];
        let changes: [fn(&mut Collection, &mut Option<u64>, &mut Arrays); 14] = [
            |c, _, _| c.env_id = "x".into(),
            |c, _, _| c.model_id = "0".repeat(64),
            |c, _, _| c.style = "x".into(),
            |c, _, _| c.source = "x".into(),
            |c, _, _| c.n_states = 6,
            |c, _, _| c.n_actions = 3,
            |_, s, _| *s = None,
            |_, s, _| *s = Some(0),
            |_, _, a| a.states = pack_u32(&[0, 4, 3]),
            |_, _, a| a.actions = pack_u32(&[1, 0, 0]),
            |_, _, a| a.rewards = Bytes::new(),
            |_, _, a| a.final_state = None,
            |_, _, a| a.terminated = true,
            |_, _, a| a.truncated = true,
        ];
        for change in changes {
            let (mut c, mut s, mut a) = (collection.clone(), seed, arrays.clone());
            change(&mut c, &mut s, &mut a);
            hashes.push(Recording::new(id, c, s, a).unwrap().content_hash());
        }
        let distinct = hashes.iter().collect::<std::collections::HashSet<_>>();
        assert_eq!(distinct.len(), hashes.len());
    }
}
