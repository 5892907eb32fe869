//! The Rust client of Mazeway: environments ([`Env`], [`VectorEnv`]), tabular models and roll-outs of an
//! environment server; recordings ([`Recorder`]), models and fits of a learner ([`Learner`]).
//!
//! Packed arrays of an answer are viewed where they lie ([`packed::Packed`]). Deliberately absent: simulators and learning.
//!
//! ```no_run
//! # async fn example() -> Result<(), mazeway_client::ClientError> {
//! let mut env = mazeway_client::Env::connect("127.0.0.1:50051", "Maze-v0", Default::default()).await?;
//! let (mut observation, _info) = env.reset(Some(7)).await?;
//! loop {
//!     let action = observation.discrete().unwrap_or(0) % env.spec().n_actions;
//!     let step = env.step(action).await?;
//!     observation = step.observation;
//!     if step.terminated || step.truncated {
//!         break;
//!     }
//! }
//! env.close().await
//! # }
//! ```

mod connect;
mod connection;
mod env;
mod error;
pub mod info;
pub mod learner;
pub mod model;
pub mod packed;
mod patience;
pub mod recorder;
mod retry;
pub mod rollout;
mod session;
pub mod spec;
mod stream;
mod vector;
mod watch;

pub use connect::{ClientCertificate, ConnectFiles, ConnectOptions, Token, Wire, channel};
pub use connection::{Connection, list_environments, model, rollout};
pub use env::{Env, Step};
pub use error::ClientError;
pub use info::{Infos, Observation, Observations};
pub use learner::Learner;
pub use model::{FeatureDomain, FeatureTable, Grid, Model, ModelCollector, ModelError, ModelLimits};
pub use recorder::{Demonstration, Receipt, Recorder};
pub use rollout::{Controller, Episode, EpisodeStream, Episodes, Rollout};
pub use session::{Autoreset, Image, SessionOptions};
pub use spec::{EnvSpec, Options};
pub use tonic::Code;
pub use vector::{ResetBatch, Seeds, StepBatch, VectorEnv};
pub use watch::{Frame, Frames, PictureMode, WatchOptions};
