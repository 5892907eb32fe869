//! The planners, one file each.

pub(super) mod expectation_maximization;
pub(super) mod finite;
pub(super) mod policy_iteration;
pub(super) mod soft;
pub(super) mod value_iteration;
