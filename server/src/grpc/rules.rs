//! What a caller needs for each method of this server, and which of them stream.

use mazeway_serving::{
    grant::Scope,
    rules::{Need, Rule},
};

/// Acting is one scope on both faces: whoever may make a session may do everything with its own.
const ACT: Need = Need::Scope(&[Scope::Act]);

/// The rule of a path.
pub fn rule(path: &str) -> Rule {
    match path.strip_prefix('/').and_then(|path| path.split_once('/')) {
        Some(
            ("mazeway.env.v1.EnvironmentService", "Interact" | "Rollout" | "GetModel" | "Watch")
            | ("dm_env_rpc.v1.Environment", "Process"),
        ) => Rule::stream(ACT),
        Some(("mazeway.env.v1.EnvironmentService" | "dm_env_rpc.v1.Environment", _)) => Rule::call(ACT),
        _ => Rule::call(Need::Token),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message as _;

    #[test]
    fn every_stream_is_known_for_one_and_every_method_needs_a_scope() {
        for set in [mazeway_proto::FILE_DESCRIPTOR_SET, mazeway_proto::DM_ENV_RPC_FILE_DESCRIPTOR_SET] {
            let set = prost_types::FileDescriptorSet::decode(set).expect("descriptors");
            let served = ["mazeway.env.v1", "dm_env_rpc.v1"];
            for file in set.file.iter().filter(|file| served.contains(&file.package())) {
                for service in &file.service {
                    for method in &service.method {
                        let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                        let streams = method.client_streaming() || method.server_streaming();
                        assert_eq!(rule(&path), Rule { need: ACT, streams }, "{path}");
                    }
                }
            }
        }
        assert_eq!(rule("/nobody/Knows").need, Need::Token);
        assert_eq!(rule("").need, Need::Token);
    }
}
