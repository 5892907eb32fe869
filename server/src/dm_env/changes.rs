//! What a request may change of a world, and what it asks for in making one.

use super::{error::WorldError, settings::Settings, world::World};
use crate::{
    batch::{Autoreset, Batch, BatchOptions},
    config::Config,
    grpc::CallError,
    registry::{Environment, Options, Registry},
};
use std::{sync::Arc, time::Duration};

/// Names of the settings of a reset, for messages.
const CHANGES: &str = "seed, max_episode_steps and options.NAME";
/// Names of the settings of a world, for messages.
const SETTINGS: &str = "env_id, num_envs, seed, max_episode_steps, lease_secs and options.NAME";

/// Settings of the sequences to come.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Changes {
    /// Seed of the next sequence.
    pub seed: Option<u64>,
    /// Steps after which a sequence is interrupted; 0 means never.
    pub max_episode_steps: Option<u32>,
    /// Options that take the place of those in force.
    pub options: Options,
}

impl Changes {
    fn read(settings: &mut Settings) -> Result<Self, WorldError> {
        Ok(Self {
            seed: settings.integer("seed", 0, u64::MAX)?,
            max_episode_steps: settings
                .integer("max_episode_steps", 0, u64::from(u32::MAX))?
                .map(|steps| u32::try_from(steps).unwrap_or(u32::MAX)),
            options: settings.options()?,
        })
    }

    /// The settings of a join, a reset or a reset of a world.
    pub fn from_settings(mut settings: Settings) -> Result<Self, WorldError> {
        let changes = Self::read(&mut settings)?;
        settings.finish(CHANGES)?;
        Ok(changes)
    }

    /// True where an environment is to be configured anew, which may take a while.
    pub fn are_costly(&self) -> bool {
        self.max_episode_steps.is_some() || !self.options.is_empty()
    }
}

/// A request for a world.
#[derive(Debug)]
pub struct NewWorld {
    env_id: String,
    /// `None` for a single environment, whose tensors have no dimension for the batch.
    batch: Option<usize>,
    /// How long it outlives its last use; `None`: it ends with the connection that made it, or with the default lease.
    pub lease: Option<Duration>,
    changes: Changes,
}

impl NewWorld {
    /// The settings of a new world.
    pub fn from_settings(mut settings: Settings) -> Result<Self, WorldError> {
        let env_id = settings.text("env_id")?.ok_or_else(|| {
            WorldError::malformed("settings.env_id", "expected the id of an environment, got no such setting")
        })?;
        let batch = settings.integer("num_envs", 1, u64::from(u32::MAX))?.map(|n| n as usize);
        let lease = settings.seconds("lease_secs")?;
        let changes = Changes::read(&mut settings)?;
        settings.finish(SETTINGS)?;
        Ok(Self { env_id, batch, lease, changes })
    }

    /// Number of environments.
    pub fn num_envs(&self) -> usize {
        self.batch.unwrap_or(1)
    }

    /// Checks everything and says how to make the world, for when there is room for it.
    pub fn plan(self, registry: &Registry, config: &Config) -> Result<impl FnOnce() -> Box<dyn Batch>, WorldError> {
        let Self { env_id, batch, changes, .. } = self;
        let (environment, options) =
            configured(registry, config, &env_id, &changes.options, batch.unwrap_or(1), |spec| {
                changes.max_episode_steps.unwrap_or(spec)
            })?;
        Ok(move || -> Box<dyn Batch> {
            Box::new(World::new(environment.batch(options), batch.is_some(), changes.options, changes.seed))
        })
    }
}

/// An environment under options and how to make a batch of it, once its replies are known to fit into a message.
pub fn configured(
    registry: &Registry,
    config: &Config,
    env_id: &str,
    options: &Options,
    num_envs: usize,
    max_episode_steps: impl FnOnce(u32) -> u32,
) -> Result<(Arc<dyn Environment>, BatchOptions), WorldError> {
    let environment = registry.configure(env_id, options)?;
    let spec = environment.spec();
    let options = BatchOptions {
        num_envs,
        // The step after the last one of a sequence begins the next one.
        autoreset: Autoreset::NextStep,
        max_episode_steps: max_episode_steps(spec.max_episode_steps),
        action_masks: true,
    };
    let (asked, limit) = (super::specs::largest_reply(spec, options), config.max_message_bytes);
    if asked > limit {
        let what = "bytes in a reply";
        return Err(CallError::Limit { field: "num_envs", what, limit: limit as u64, asked: asked as u64 }.into());
    }
    Ok((environment, options))
}

impl Changes {
    /// Makes a world change from its next sequence on. `told` says that whoever is in it learns of other specs.
    ///
    /// # Errors
    /// A wrong option, replies too large for a message, specs that would change untold. Nothing has changed then.
    pub fn apply(self, world: &mut World, registry: &Registry, config: &Config, told: bool) -> Result<(), WorldError> {
        let costly = self.are_costly();
        let Self { seed, max_episode_steps, options } = self;
        if costly {
            let first = options.keys().next().cloned();
            let mut given = world.given().clone();
            given.extend(options);
            let now = Arc::clone(world.next_spec());
            let (env_id, present) = (now.env_id, world.next_options());
            let (environment, options) = configured(registry, config, env_id, &given, present.num_envs, |_| {
                max_episode_steps.unwrap_or(present.max_episode_steps)
            })?;
            let then = environment.spec();
            let same = (&now.observation_space, now.n_actions, &now.info_columns)
                == (&then.observation_space, then.n_actions, &then.info_columns);
            if !told && !same {
                return Err(WorldError::SpecsWouldChange {
                    field: first.map_or_else(|| "settings".into(), |name| format!("settings.options.{name}")),
                    message:
                        "this would change the specs: give it in the settings of a reset request, whose answer has \
                              the new ones"
                            .into(),
                });
            }
            world.set_next(given, environment, options);
        }
        if let Some(seed) = seed {
            world.set_seed(seed);
        }
        Ok(())
    }
}
