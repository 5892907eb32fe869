//! From the wire to the core: every request is checked here and nothing is computed.

use super::status::CallError;
use crate::{
    batch::{Autoreset, Seeds},
    registry::Options,
    rollout::{Controller, RolloutError, RolloutPlan, TabularPolicy},
    sessions::SessionId,
    sim::{EnvSpec, options::shortened},
};
use mazeway_proto::env as pb;
use prost_types::value::Kind;
use serde_json::{Number, Value};
use std::time::Duration;

/// Largest integer up to which every integer is a float64.
const MAX_EXACT: f64 = 9_007_199_254_740_992.0;

/// Options by name; numbers without a fraction become integers.
pub fn options(options: Option<prost_types::Struct>) -> Result<Options, CallError> {
    let fields = options.unwrap_or_default().fields;
    let options = fields.into_iter().map(|(name, wire)| match value(wire) {
        Ok(value) => Ok((name, value)),
        Err(wrong) => Err(wrong.under(&name)),
    });
    options.collect::<Result<_, NotFinite>>().map_err(|NotFinite { path, got }| {
        CallError::malformed(format!("options{path}"), format!("expected a finite number, got {got}"))
    })
}

/// A number that is none, and where: the path is written on the way out, so that right values need none.
struct NotFinite {
    path: String,
    got: f64,
}

impl NotFinite {
    fn under(self, key: &str) -> Self {
        Self { path: format!(".{}{}", shortened(key), self.path), ..self }
    }
}

fn value(value: prost_types::Value) -> Result<Value, NotFinite> {
    Ok(match value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(flag)) => Value::Bool(flag),
        Some(Kind::StringValue(text)) => Value::String(text),
        Some(Kind::NumberValue(number)) if number.fract() == 0.0 && number.abs() <= MAX_EXACT => {
            Value::from(number as i64)
        }
        Some(Kind::NumberValue(got)) => {
            Number::from_f64(got).map(Value::Number).ok_or_else(|| NotFinite { path: String::new(), got })?
        }
        Some(Kind::ListValue(list)) => {
            let items = list.values.into_iter().enumerate().map(|(i, item)| {
                self::value(item).map_err(|wrong| NotFinite { path: format!("[{i}]{}", wrong.path), ..wrong })
            });
            Value::Array(items.collect::<Result<_, _>>()?)
        }
        Some(Kind::StructValue(map)) => {
            let fields = map.fields.into_iter().map(|(key, wire)| match self::value(wire) {
                Ok(value) => Ok((key, value)),
                Err(wrong) => Err(wrong.under(&key)),
            });
            Value::Object(fields.collect::<Result<_, _>>()?)
        }
    })
}

/// A request for a session.
pub struct NewSession {
    pub env_id: String,
    pub options: Options,
    pub num_envs: usize,
    pub autoreset: Autoreset,
    pub max_episode_steps: Option<u32>,
    pub lease: Option<Duration>,
    pub action_masks: bool,
}

pub fn create_session(request: pb::CreateSessionRequest) -> Result<NewSession, CallError> {
    let autoreset = match pb::AutoresetMode::try_from(request.autoreset_mode) {
        Ok(pb::AutoresetMode::Unspecified | pb::AutoresetMode::NextStep) => Autoreset::NextStep,
        Ok(pb::AutoresetMode::SameStep) => Autoreset::SameStep,
        Ok(pb::AutoresetMode::Disabled) => Autoreset::Disabled,
        Err(_) => {
            let message = format!("expected a known autoreset mode, got {}", request.autoreset_mode);
            return Err(CallError::malformed("autoreset_mode", message));
        }
    };
    // Before it is converted, which overflows where it is negative beyond all bounds.
    if request.lease.as_ref().is_some_and(|lease| lease.seconds < 0 || lease.nanos < 0) {
        return Err(CallError::malformed("lease", "expected a positive duration, got a negative one"));
    }
    let lease = request.lease.map(Duration::try_from).transpose();
    let lease =
        lease.map_err(|error| CallError::malformed("lease", format!("expected a positive duration: {error}")))?;
    Ok(NewSession {
        env_id: request.env_id,
        options: options(request.options)?,
        num_envs: request.num_envs.max(1) as usize,
        autoreset,
        max_episode_steps: request.max_episode_steps,
        lease,
        action_masks: request.action_masks,
    })
}

/// An id that no session can have is an unknown one; an empty one was forgotten.
pub fn session_id(text: &str) -> Result<SessionId, CallError> {
    if text.is_empty() {
        return Err(CallError::malformed("session_id", "expected a session id, got none"));
    }
    SessionId::parse(text).ok_or(CallError::Session(crate::sessions::SessionError::Unknown))
}

pub fn reset(request: &pb::ResetRequest) -> Result<(Seeds<'_>, Option<&[u8]>), CallError> {
    let seeds = match (request.seed, request.seeds.is_empty()) {
        (Some(_), false) => return Err(CallError::malformed("seeds", "expected either seed or seeds, got both")),
        (Some(seed), true) => Seeds::From(seed),
        (None, false) => Seeds::Each(&request.seeds),
        (None, true) => Seeds::Continue,
    };
    Ok((seeds, (!request.reset_mask.is_empty()).then_some(&request.reset_mask[..])))
}

/// What a roll-out may take.
pub struct RolloutLimits {
    /// Steps in all.
    pub max_steps: u64,
    /// Bytes of a message.
    pub max_message_bytes: usize,
}

/// State, action and reward of a step.
const BYTES_A_STEP: u64 = 4 + 4 + 8;
/// Steps of a message, where it holds several episodes.
const STEPS_A_CHUNK: u64 = 1 << 16;
/// Steps computed between two messages, where these hold totals alone.
const TOTALS_STEPS_A_CHUNK: u64 = 1 << 20;
/// Most episodes of a message.
const EPISODES_A_CHUNK: u64 = 4096;

/// Checks a roll-out of an environment against its description and the limits.
pub fn rollout(request: &pb::RolloutRequest, spec: &EnvSpec, limits: &RolloutLimits) -> Result<RolloutPlan, CallError> {
    use pb::rollout_request::Controller as Wire;
    let controller = match &request.controller {
        None => return Err(RolloutError::NoController.into()),
        Some(Wire::Driver(name)) => Controller::Driver(name.clone()),
        Some(Wire::Policy(policy)) => {
            let bytes = &policy.probabilities;
            if bytes.len() % 8 != 0 {
                return Err(RolloutError::PolicyBytes { got: bytes.len() }.into());
            }
            Controller::Policy(TabularPolicy::new(&unpack_f64(bytes), spec.n_states, spec.n_actions)?)
        }
    };
    let (steps, burn_in) = (u64::from(request.steps), u64::from(request.burn_in_steps));
    let asked = (steps + burn_in).saturating_mul(u64::from(request.episodes));
    if asked > limits.max_steps {
        return Err(CallError::Limit { field: "steps", what: "steps in a roll-out", limit: limits.max_steps, asked });
    }
    let longest = (limits.max_message_bytes as u64).saturating_sub(4096) / BYTES_A_STEP;
    if !request.totals_only && steps > longest {
        let what = "steps in an episode that is not totals_only";
        return Err(CallError::Limit { field: "steps", what, limit: longest, asked: steps });
    }
    let computed = TOTALS_STEPS_A_CHUNK / (steps + burn_in).max(1);
    let sent = if request.totals_only { EPISODES_A_CHUNK } else { STEPS_A_CHUNK / steps.max(1) };
    let plan = RolloutPlan {
        controller,
        seed: request.seed,
        episodes: request.episodes,
        steps: request.steps,
        burn_in_steps: request.burn_in_steps,
        totals_only: request.totals_only,
        compact: request.compact,
        chunk_episodes: computed.min(sent).clamp(1, EPISODES_A_CHUNK) as u32,
    };
    plan.check(spec)?;
    Ok(plan)
}

/// How to draw.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RenderMode {
    Ansi,
    RgbArray,
    Png,
}

pub fn render_mode(mode: i32) -> Result<RenderMode, CallError> {
    match pb::RenderMode::try_from(mode) {
        Ok(pb::RenderMode::Unspecified | pb::RenderMode::Ansi) => Ok(RenderMode::Ansi),
        Ok(pb::RenderMode::RgbArray) => Ok(RenderMode::RgbArray),
        Ok(pb::RenderMode::Png) => Ok(RenderMode::Png),
        Err(_) => Err(CallError::malformed("mode", format!("expected a known render mode, got {mode}"))),
    }
}

fn unpack_f64(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks::<8>().0.iter().map(|bits| f64::from_le_bytes(*bits)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn options_keep_their_types_and_whole_numbers_are_integers() {
        let wire = prost_types::Struct {
            fields: [
                ("slip", Kind::NumberValue(0.25)),
                ("density", Kind::NumberValue(4.0)),
                ("style", Kind::StringValue("legal".into())),
                ("terminate_on_collision", Kind::BoolValue(true)),
                (
                    "rewards",
                    Kind::ListValue(prost_types::ListValue {
                        values: vec![prost_types::Value { kind: Some(Kind::NumberValue(-1.0)) }],
                    }),
                ),
            ]
            .map(|(name, kind)| (name.to_owned(), prost_types::Value { kind: Some(kind) }))
            .into(),
        };
        let expected =
            json!({"slip": 0.25, "density": 4, "style": "legal", "terminate_on_collision": true, "rewards": [-1]});
        assert_eq!(Value::Object(options(Some(wire)).expect("valid")), expected);
    }

    #[test]
    fn a_number_that_is_not_finite_is_named() {
        let nan = prost_types::Value { kind: Some(Kind::NumberValue(f64::NAN)) };
        let list = prost_types::Value { kind: Some(Kind::ListValue(prost_types::ListValue { values: vec![nan] })) };
        let error = options(Some(prost_types::Struct { fields: [("rewards".to_owned(), list)].into() }));
        assert_eq!(error.expect_err("refused").field().as_deref(), Some("options.rewards[0]"));
    }

    #[test]
    fn seed_excludes_seeds() {
        let request = pb::ResetRequest { seed: Some(1), seeds: vec![0; 8].into(), ..Default::default() };
        assert_eq!(reset(&request).expect_err("refused").field().as_deref(), Some("seeds"));
    }
}
