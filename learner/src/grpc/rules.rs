//! What a caller needs for each method of this service, and which of them stream.

use mazeway_serving::{
    grant::Scope,
    rules::{Need, Rule},
};

/// Adding demonstrations, and the models that they were made in.
const RECORD: Need = Need::Scope(&[Scope::Record]);
/// Which models there are is asked by those who record as well.
const MODELS: Need = Need::Scope(&[Scope::Record, Scope::Fit]);
/// Fitting, and reading what is stored: the demonstrations that a fit could be asked about.
const FIT: Need = Need::Scope(&[Scope::Fit]);
/// Whatever takes away, and whatever has no rule of its own.
const ADMIN: Need = Need::Scope(&[Scope::Admin]);

/// The rule of a path.
pub fn rule(path: &str) -> Rule {
    match path.strip_prefix('/').and_then(|path| path.split_once('/')) {
        Some(("mazeway.learner.v1.LearnerService", method)) => match method {
            "RecordTrajectories" | "PutModel" => Rule::stream(RECORD),
            "GetModel" => Rule::stream(MODELS),
            "ListModels" => Rule::call(MODELS),
            "ExportTrajectories" | "Fit" => Rule::stream(FIT),
            "ListTrajectories" | "ListFitTrajectories" | "GetFit" | "ListFits" => Rule::call(FIT),
            _ => Rule::call(ADMIN),
        },
        _ => Rule::call(Need::Token),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message as _;

    #[test]
    fn every_stream_is_known_for_one_and_only_deleting_is_for_admins() {
        let set = prost_types::FileDescriptorSet::decode(mazeway_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
        let mut seen = 0;
        for file in set.file.iter().filter(|file| file.package() == "mazeway.learner.v1") {
            for (service, method) in file.service.iter().flat_map(|s| s.method.iter().map(move |m| (s, m))) {
                let rule = rule(&format!("/{}.{}/{}", file.package(), service.name(), method.name()));
                assert_eq!(rule.streams, method.client_streaming() || method.server_streaming(), "{}", method.name());
                assert_eq!(rule.need == ADMIN, method.name().starts_with("Delete"), "{}", method.name());
                seen += 1;
            }
        }
        assert!(seen > 10, "{seen} methods");
        assert_eq!(rule("/nobody/Knows").need, Need::Token);
    }
}
