//! The methods that a service has: what calls are counted and named by. Whatever else a client asks for is one of these for
//! all, so that no client makes a number.

use crate::rules::{COMMON, Need, Rules};
use prost::Message as _;
use prost_types::FileDescriptorSet;
use std::{collections::HashSet, sync::Arc};

/// What stands for every method that there is not.
pub const OTHER: &str = "other";

/// Methods as gRPC writes them, `mazeway.env.v1.EnvironmentService/Step`.
#[derive(Debug, Default)]
pub struct Methods(HashSet<Arc<str>>);

impl Methods {
    /// Those of the protocols that have a rule among `rules`, and those that every service has.
    pub fn served(rules: Rules) -> Self {
        let mut methods: HashSet<Arc<str>> = COMMON.map(Arc::from).into();
        for set in [mazeway_proto::FILE_DESCRIPTOR_SET, mazeway_proto::DM_ENV_RPC_FILE_DESCRIPTOR_SET] {
            // It is ours and reads.
            let set = FileDescriptorSet::decode(set).unwrap_or_default();
            for file in &set.file {
                for (service, method) in file.service.iter().flat_map(|s| s.method.iter().map(move |m| (s, m))) {
                    let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                    if matches!(rules(&path).need, Need::Scope(_)) {
                        methods.insert(path[1..].into());
                    }
                }
            }
        }
        Self(methods)
    }

    /// The method of a path, if there is one.
    pub fn of(&self, path: &str) -> Option<&Arc<str>> {
        self.0.get(path.strip_prefix('/')?)
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<str>> {
        self.0.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{grant::Scope, rules::Rule};

    #[test]
    fn what_is_served_is_known_and_nothing_else() {
        let methods = Methods::served(|path| {
            Rule::call(if path.starts_with("/mazeway.env.") { Need::Scope(&[Scope::Act]) } else { Need::Token })
        });
        for path in ["mazeway.env.v1.EnvironmentService/Step", "grpc.health.v1.Health/Watch"] {
            assert_eq!(methods.of(&format!("/{path}")).map(AsRef::as_ref), Some(path));
            assert!(methods.of(path).is_none() && methods.of(&format!("//{path}")).is_none());
        }
        for path in ["", "/", "/mazeway.env.v1.EnvironmentService/Steps", "/mazeway.learner.v1.LearnerService/Fit"] {
            assert!(methods.of(path).is_none(), "{path}");
        }
    }
}
