//! What a caller needs for a method, and how long a call of it may last.

use crate::grant::Scope;

/// What a caller must show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Need {
    /// Nothing: anybody may ask whether the service is well.
    Nothing,
    /// A token, whatever it is good for.
    Token,
    /// A token that is good for one of these.
    Scope(&'static [Scope]),
}

/// What holds for a method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rule {
    /// What it needs.
    pub need: Need,
    /// A stream lasts as long as its peers want; every other call has a deadline.
    pub streams: bool,
}

impl Rule {
    /// A call with one request and one answer.
    pub const fn call(need: Need) -> Self {
        Self { need, streams: false }
    }

    /// A call that streams either way.
    pub const fn stream(need: Need) -> Self {
        Self { need, streams: true }
    }
}

/// The rule of a path, such as `/mazeway.env.v1.EnvironmentService/Step`. For a path that nobody serves it says something
/// that lets nobody in.
pub type Rules = fn(&str) -> Rule;

/// Health and reflection, which every service has, as gRPC writes methods.
pub const COMMON: [&str; 4] = [
    "grpc.health.v1.Health/Check",
    "grpc.health.v1.Health/Watch",
    "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
    "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
];

/// Health, which is open, and reflection, which needs a token unless it is `open`; `None` for every other path.
pub fn common(path: &str, open_reflection: bool) -> Option<Rule> {
    let (service, method) = path.strip_prefix('/')?.split_once('/')?;
    match service {
        "grpc.health.v1.Health" => Some(Rule { need: Need::Nothing, streams: method == "Watch" }),
        "grpc.reflection.v1.ServerReflection" | "grpc.reflection.v1alpha.ServerReflection" => {
            Some(Rule::stream(if open_reflection { Need::Nothing } else { Need::Token }))
        }
        _ => None,
    }
}
