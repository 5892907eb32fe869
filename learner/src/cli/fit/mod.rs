//! `learner fit`.

use super::{StoreArgs, error::CliError};
use clap::Args;

/// What to fit, and how.
#[derive(Debug, Args)]
pub struct FitArgs {
    /// Where recordings are read from and the fit is kept.
    #[command(flatten)]
    pub store: StoreArgs,
}

/// Fits and reports.
#[expect(clippy::unused_async, reason = "the fit itself awaits the services")]
pub async fn run(args: FitArgs) -> Result<(), CliError> {
    Err(CliError::failure(format!("cannot fit from {:?} yet", args.store), "see 'learner --help'"))
}
