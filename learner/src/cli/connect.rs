//! A learner to ask: a running one where an address is given, else the real one on the data directory, for this command.

use super::{
    StoreArgs, data_directory,
    embedded::{self, Embedded},
    error::CliError,
    unreachable,
};
use mazeway_client::{ClientError, Learner};
use std::path::PathBuf;

/// A connection, and the guard of what was started for it.
pub struct Connected {
    /// The client.
    pub learner: Learner,
    embedded: Option<Embedded>,
}

/// Connects as the arguments say.
///
/// # Errors
/// Nobody answers at the address; the data directory cannot be used.
pub async fn connect(store: &StoreArgs) -> Result<Connected, CliError> {
    if let Some(address) = &store.addr {
        let options = store.access.options(address)?;
        let learner = Learner::connect_with(address, &options).await.map_err(|error| match error {
            ClientError::Argument { .. } => unreachable(&error, ""),
            error => error.into(),
        })?;
        return Ok(Connected { learner, embedded: None });
    }
    connect_to_data(store.data.clone()).await
}

/// Starts a learner service on a data directory, else on the platform's, and connects to it.
///
/// # Errors
/// The data directory cannot be used.
pub async fn connect_to_data(data: Option<PathBuf>) -> Result<Connected, CliError> {
    let service = embedded::learner(&data_directory(data)?).await?;
    let learner = Learner::connect(&service.address()).await?;
    Ok(Connected { learner, embedded: Some(service) })
}

impl Connected {
    /// Ends the connection and what was started for it. `outcome` comes first where both fail.
    pub async fn finish<T>(self, outcome: Result<T, CliError>) -> Result<T, CliError> {
        drop(self.learner);
        let stopped = match self.embedded {
            Some(service) => service.stop().await,
            None => Ok(()),
        };
        let value = outcome?;
        stopped.map(|()| value)
    }
}
