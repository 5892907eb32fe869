//! Answers of the fast path, written from a batch's block straight into what is sent.
//!
//! The bytes are those that prost would write of [`mazeway_proto::env::InteractResponse`], with gRPC's frame before them.

use crate::batch::StepBuffers;
use bytes::{BufMut as _, BytesMut};
use prost::encoding::{WireType, encode_key, encode_varint, encoded_len_varint, key_len};

/// Bytes of gRPC's frame: a flag and the length of the message.
const FRAME_LEN: usize = 5;

/// Fields of `InteractResponse`.
const RESET: u32 = 1;
const STEP: u32 = 2;
const CLOSE: u32 = 3;

/// Appends the answer to a reset.
pub fn reset(buffers: &StepBuffers, out: &mut BytesMut) {
    let columns = 0..buffers.layout().infos.len();
    let parts = || single(1, buffers.observations()).chain(columns.clone().map(|i| (2, buffers.info(i))));
    message(RESET, parts, out);
}

/// Appends the answer to a step.
pub fn step(buffers: &StepBuffers, out: &mut BytesMut) {
    let columns = 0..buffers.layout().infos.len();
    let last = if buffers.has_final() { columns.clone() } else { 0..0 };
    let parts = || {
        single(1, buffers.observations())
            .chain(single(2, buffers.rewards()))
            .chain(single(3, buffers.terminated()))
            .chain(single(4, buffers.truncated()))
            .chain(columns.clone().map(|i| (5, buffers.info(i))))
            .chain(single(6, buffers.final_observations()))
            .chain(last.clone().map(|i| (7, buffers.final_info(i))))
    };
    message(STEP, parts, out);
}

/// Appends the answer to a close.
pub fn close(out: &mut BytesMut) {
    message(CLOSE, std::iter::empty::<(u32, &[u8])>, out);
}

/// A field that is left out where it is empty, as proto3 has it.
fn single(number: u32, bytes: &[u8]) -> impl Iterator<Item = (u32, &[u8])> {
    (!bytes.is_empty()).then_some((number, bytes)).into_iter()
}

/// Bytes of a field with its key and its length.
fn field_len(number: u32, len: usize) -> usize {
    key_len(number) + encoded_len_varint(len as u64) + len
}

fn begin_field(number: u32, len: usize, out: &mut BytesMut) {
    encode_key(number, WireType::LengthDelimited, out);
    encode_varint(len as u64, out);
}

/// Appends one framed `InteractResponse` whose field `answer` is a message of these fields.
fn message<'a, I: Iterator<Item = (u32, &'a [u8])>>(answer: u32, parts: impl Fn() -> I, out: &mut BytesMut) {
    let len = parts().map(|(number, bytes)| field_len(number, bytes.len())).sum();
    let whole = field_len(answer, len);
    out.reserve(FRAME_LEN + whole);
    // Not compressed.
    out.put_u8(0);
    out.put_u32(whole as u32);
    begin_field(answer, len, out);
    for (number, bytes) in parts() {
        begin_field(number, bytes.len(), out);
        out.put_slice(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        batch::{Autoreset, BatchOptions, Seeds},
        grpc::to_proto,
        registry::Registry,
    };
    use mazeway_proto::env::{self as pb, interact_response::Response};
    use prost::Message as _;
    use serde_json::{Map, json};

    fn framed(response: Response) -> Vec<u8> {
        let message = pb::InteractResponse { response: Some(response) }.encode_to_vec();
        [&[0][..], &(message.len() as u32).to_be_bytes(), &message].concat()
    }

    #[test]
    fn answers_are_what_prost_writes() {
        let kinematics = json!({"observation": "kinematics"});
        for (env_id, options, num_envs) in [
            ("Maze-v0", Map::new(), 1),
            ("Maze-v0", Map::new(), 700),
            ("Highway-v0", Map::new(), 1),
            ("Highway-v0", kinematics.as_object().expect("an object").clone(), 40),
        ] {
            for autoreset in [Autoreset::NextStep, Autoreset::SameStep] {
                let options_of_batch =
                    BatchOptions { num_envs, autoreset, max_episode_steps: 3, action_masks: num_envs > 1 };
                let environment = Registry::new().configure(env_id, &options).expect("an environment");
                let mut batch = environment.batch(options_of_batch);
                let mut out = BytesMut::new();
                let first = batch.reset(Seeds::From(1), None).expect("resets");
                reset(first, &mut out);
                let mut expected = framed(Response::Reset(to_proto::reset(first)));
                let mut ended = 0;
                for _ in 0..7 {
                    let stepped = batch.step(&vec![0; num_envs * 4]).expect("steps");
                    ended += usize::from(stepped.has_final());
                    step(stepped, &mut out);
                    expected.extend(framed(Response::Step(to_proto::step(stepped))));
                }
                close(&mut out);
                expected.extend(framed(Response::Close(pb::CloseSessionResponse {})));
                assert_eq!(ended > 0, autoreset == Autoreset::SameStep);
                assert!(out == expected, "{env_id} x {num_envs}, {autoreset:?}");
            }
        }
    }
}
