//! The command `token` of every service: makes a token, shows its secret once, and puts its entry into a file.

use crate::{
    grant::{Quotas, Scope},
    keyring, tokens,
};
use std::{
    path::PathBuf,
    time::{Duration, SystemTime},
};

/// What the new token is to be.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct TokenArgs {
    /// Whose it is: in logs, spans and queues, and for what it owns
    #[arg(value_name = "NAME", value_parser = name)]
    pub name: String,
    /// What it is good for, separated by commas: act, record, fit, admin
    #[arg(long, value_name = "SCOPES", value_delimiter = ',', required = true)]
    pub scopes: Vec<Scope>,
    /// How long it is good for, such as 90d or 12h [default: until it is taken out of the file]
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    pub expires_in: Option<Duration>,
    /// Sessions that it may have at a time
    #[arg(long, value_name = "N")]
    pub max_sessions: Option<usize>,
    /// Environments that all its sessions may have together
    #[arg(long, value_name = "N")]
    pub max_envs: Option<usize>,
    /// Bytes of demonstrations and models that it may record in all; deleting gives none back
    #[arg(long, value_name = "BYTES")]
    pub max_recorded_bytes: Option<u64>,
    /// Fits that it may have waiting and running at a time
    #[arg(long, value_name = "N")]
    pub max_fits: Option<usize>,
    /// Append the entry to this file of tokens, which is made, readable by its owner alone, where it is missing; running
    /// services take it over within seconds
    #[arg(long, value_name = "FILE")]
    pub append: Option<PathBuf>,
}

/// Longest time that a token may be good for.
const LONGEST: Duration = Duration::from_hours(24 * 365 * 100);

fn name(text: &str) -> Result<String, String> {
    let checked = tokens::check_name(text).map(|()| text.to_owned());
    checked.map_err(|error| error.strip_prefix("name: ").unwrap_or(&error).to_owned())
}

fn lifetime(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(time) if !time.is_zero() && time <= LONGEST => Ok(time),
        _ => Err("expected a time above 0 and up to a hundred years, with its unit, such as 90d or 12h".into()),
    }
}

impl TokenArgs {
    /// Makes the token, and gives the lines for standard output: the secret alone where the entry went into a file, else
    /// the secret and the entry.
    ///
    /// # Errors
    /// What is wrong, and what to do.
    pub fn run(&self) -> Result<String, (String, &'static str)> {
        let quotas = Quotas {
            max_sessions: self.max_sessions,
            max_envs: self.max_envs,
            max_recorded_bytes: self.max_recorded_bytes,
            max_fits: self.max_fits,
        };
        let end = |time| SystemTime::now().checked_add(time);
        let too_long = || ("expected an end that can be written as a date".to_owned(), "leave out --expires-in");
        let expires = self.expires_in.map(|time| end(time).ok_or_else(too_long)).transpose()?;
        let minted = tokens::mint(&self.name, &self.scopes, &quotas, expires)
            .map_err(|error| (error, "name the token after who or what will use it, such as alice or ci-runner"))?;
        match &self.append {
            None => Ok(format!("{}\n\n{}", minted.secret, minted.entry)),
            Some(path) => {
                keyring::append(path, &minted.entry)
                    .map_err(|error| (error.to_string(), "choose another name, or another file"))?;
                Ok(format!("{}\n", minted.secret))
            }
        }
    }
}
