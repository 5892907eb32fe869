//! An environment as an experiment sees it: its model, its expert, and the demonstrations that the expert gives.
//!
//! Everything comes from a real environment server through the real client. Invariant: a demonstration is a function of the
//! environment, its options and a seed; those of `learner fit --seed S` and of a comparison's seed S are the same.

use super::{
    AccessArgs,
    embedded::{self, Embedded},
    error::CliError,
    fit::{
        assemble::Truth,
        recordings::{Expert, demonstration_seed, evaluation_seed},
    },
    unreachable,
};
use mazeway_client::{ConnectOptions, Connection, EnvSpec, Episodes, Model, Options, Rollout};
use mazeway_learner::{
    mdp::{PlanOptions, PlannerKind, TabularMdp, plan},
    trajectory::Trajectory,
};

/// An environment server: the one at an address, or one that lives as long as this.
pub struct Environments {
    /// Connection to it.
    pub connection: Connection,
    /// Where it listens.
    pub address: String,
    embedded: Option<Embedded>,
}

impl Environments {
    /// Connects, or starts one.
    ///
    /// # Errors
    /// Nobody answers at the address; no port can be bound.
    pub async fn start(address: Option<&str>, access: &AccessArgs) -> Result<Self, CliError> {
        let embedded = match address {
            Some(_) => None,
            None => Some(embedded::environments().await?),
        };
        let address = match (&embedded, address) {
            (Some(embedded), _) => embedded.address(),
            (None, Some(address)) => address.to_owned(),
            (None, None) => unreachable!("started above"),
        };
        let options = if embedded.is_some() { ConnectOptions::default() } else { access.options(&address)? };
        let connection = Connection::connect(&address, &options).await.map_err(|error| {
            unreachable(&error, format!("start one with 'server --listen {address}', or leave out --env-addr"))
        })?;
        Ok(Self { connection, address, embedded })
    }

    /// Stops what was started.
    ///
    /// # Errors
    /// It failed meanwhile.
    pub async fn stop(self) -> Result<(), CliError> {
        drop(self.connection);
        match self.embedded {
            Some(embedded) => embedded.stop().await,
            None => Ok(()),
        }
    }
}

/// Description of an environment.
///
/// # Errors
/// There is none of that name.
pub async fn spec(environments: &Connection, env_id: &str) -> Result<EnvSpec, CliError> {
    let mut specs = environments.list_environments().await?;
    if let Some(rank) = specs.iter().position(|spec| spec.env_id == env_id) {
        return Ok(specs.swap_remove(rank));
    }
    let known: Vec<_> = specs.iter().map(|spec| spec.env_id.as_str()).collect();
    Err(CliError::usage(
        format!("unknown environment '{env_id}' for --env"),
        format!("choose one of {}", known.join(", ")),
    ))
}

/// An environment's tabular model.
///
/// # Errors
/// Wrong options; the server fails.
pub async fn model(environments: &Connection, spec: &EnvSpec, options: &Options) -> Result<Model, CliError> {
    environments.model(&spec.env_id, options).await.map_err(|error| {
        if !error.field().is_some_and(|field| field.starts_with("options")) {
            return error.into();
        }
        let known: Vec<_> = spec.options.iter().map(|option| format!("{}={}", option.name, option.default)).collect();
        CliError::usage(
            format!("wrong --env-option: {error}"),
            format!("{} takes, with their defaults: {}", spec.env_id, known.join(", ")),
        )
    })
}

/// A served model as the mathematics takes it.
///
/// # Errors
/// It is none.
pub fn checked(model: &Model) -> Result<TabularMdp, CliError> {
    TabularMdp::new(
        model.n_states as usize,
        model.n_actions as usize,
        model.row_offsets.clone(),
        model.next_states.clone(),
        model.probabilities.clone(),
        Some(model.initial_distribution.clone()),
    )
    .map_err(|error| {
        CliError::failure(
            format!("the server's model is not one: {error}"),
            "check the server's version with 'server --version'",
        )
    })
}

/// The true reward and the optimal policy under it, where the model is exact and carries the style's reward. Where the
/// discount is 1 it is planned for the steps of the horizon.
///
/// # Errors
/// The planner refuses.
pub fn truth(
    (discount, horizon): (f64, Option<u32>),
    style: &str,
    model: &Model,
    mdp: &TabularMdp,
) -> Result<Option<Truth>, CliError> {
    let Some(reward) = model.reward(style).filter(|_| !model.estimated) else { return Ok(None) };
    let options = PlanOptions { discount, horizon, ..PlanOptions::default() };
    let optimal = plan(PlannerKind::PolicyIteration, mdp, reward, &options).map_err(|error| {
        CliError::failure(format!("cannot plan under the true reward: {error}"), "try another --discount")
    })?;
    Ok(Some(Truth { reward: reward.to_vec(), optimal_policy: optimal.greedy_policy().into_probabilities() }))
}

/// An environment, its model and its expert.
pub struct Scene {
    /// The server.
    pub environments: Connection,
    /// Description.
    pub spec: EnvSpec,
    /// Options.
    pub options: Options,
    /// Style of the expert.
    pub style: String,
    /// Model as served.
    pub model: Model,
    /// The same, checked.
    pub mdp: TabularMdp,
    /// True reward, where it is known.
    pub truth: Option<Truth>,
    /// Who demonstrates.
    pub expert: Expert,
}

impl Scene {
    /// Asks the server for everything; without a style, the environment's first.
    ///
    /// # Errors
    /// No such environment, wrong options, a style without an expert, a server that fails.
    pub async fn open(
        environments: &Connection,
        env_id: &str,
        options: Options,
        style: Option<&str>,
        (discount, horizon): (f64, Option<u32>),
    ) -> Result<Self, CliError> {
        let spec = spec(environments, env_id).await?;
        let style = style.or(spec.styles.first().map(String::as_str)).unwrap_or_default().to_owned();
        let model = model(environments, &spec, &options).await?;
        let mdp = checked(&model)?;
        let truth = truth((discount, horizon), &style, &model, &mdp)?;
        let expert = match &truth {
            Some(truth) => Expert::optimal(truth.optimal_policy.clone(), discount),
            None if spec.drivers.iter().any(|(name, _)| *name == style && name != "random") => Expert::driver(&style),
            None => {
                return Err(CliError::usage(
                    format!("no scripted expert of {env_id} drives in style '{style}'"),
                    format!("choose one of {}", spec.styles.join(", ")),
                ));
            }
        };
        Ok(Self { environments: environments.clone(), spec, options, style, model, mdp, truth, expert })
    }

    /// The first `episodes` demonstrations of a seed; fewer are the first of more.
    ///
    /// # Errors
    /// The server fails.
    pub async fn demonstrations(&self, seed: u32, episodes: u32, steps: u32) -> Result<Vec<Trajectory>, CliError> {
        self.drive(demonstration_seed(seed), episodes, steps).await
    }

    /// Episodes of the expert that no demonstration shares.
    ///
    /// # Errors
    /// The server fails.
    pub async fn held_out(&self, seed: u32, episodes: u32, steps: u32) -> Result<Vec<Trajectory>, CliError> {
        self.drive(evaluation_seed(seed), episodes, steps).await
    }

    async fn drive(&self, seed: u64, episodes: u32, steps: u32) -> Result<Vec<Trajectory>, CliError> {
        let rollout = Rollout {
            options: self.options.clone(),
            seed,
            burn_in_steps: self.expert.burn_in_steps,
            ..Rollout::new(&self.spec.env_id, self.expert.controller.clone(), episodes, steps)
        };
        self.trajectories(&self.environments.rollout(rollout).await?)
    }

    /// Episodes as the mathematics takes them.
    ///
    /// # Errors
    /// They do not belong to the model.
    fn trajectories(&self, episodes: &Episodes) -> Result<Vec<Trajectory>, CliError> {
        let (n_states, n_actions) = (self.model.n_states, self.model.n_actions);
        let episode = |episode: mazeway_client::Episode<'_>| {
            Trajectory::new(
                episode.states.to_vec(),
                episode.actions.to_vec(),
                Some(episode.final_state),
                n_states,
                n_actions,
            )
        };
        episodes.iter().map(episode).collect::<Result<_, _>>().map_err(|error| {
            CliError::failure(
                format!("the server's episode is none of its model: {error}"),
                "check the server's version with 'server --version'",
            )
        })
    }
}
