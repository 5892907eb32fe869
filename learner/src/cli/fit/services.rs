//! The two services behind a fit: running ones where addresses are given, else the real ones started in process on loopback
//! ports. Everything else in `learner fit` sees a connection and not how it came about.

use super::{args::FitArgs, job::Job, narrate::Narrator};
use crate::cli::{
    data_directory,
    embedded::{self, Embedded},
    error::CliError,
    scene, unreachable,
};
use mazeway_client::{
    Code, ConnectOptions, Connection, Env, EnvSpec, Episodes, Learner, Model, Rollout, SessionOptions, packed::Packed,
};
use mazeway_learner::report::Source;
use mazeway_proto::learner::{Fit, FitRequest, Trajectory, TrajectoryFilter, fit_response::Event};
use std::path::{Path, PathBuf};

/// Port of an environment server beside a learner service, where none is named.
const ENVIRONMENTS_PORT: u16 = 50051;

/// Connections, and the guards of what was started for them.
pub struct Services {
    /// Why there is none, where there is none.
    environments: Result<Connection, CliError>,
    learner: Learner,
    data: PathBuf,
    embedded: Vec<Embedded>,
}

impl Services {
    /// Connects to the services that the arguments name, and starts those that they do not name.
    ///
    /// # Errors
    /// Nobody answers at an address; a data directory that cannot be used.
    pub async fn start(args: &FitArgs, narrator: Narrator) -> Result<Self, CliError> {
        let mut running = Vec::new();
        let data = data_directory(args.store.data.clone())?;
        let learner_address = if let Some(address) = &args.store.addr {
            address.clone()
        } else {
            let learner = embedded::learner(&data).await?;
            let address = learner.address();
            running.push(learner);
            narrator.step("started", format_args!("learner service at {address}, data in {}", data.display()))?;
            address
        };
        let environments_address = match (&args.env_addr, &args.store.addr) {
            (Some(address), _) => address.clone(),
            (None, Some(learner)) => beside(learner),
            (None, None) => {
                let server = embedded::environments().await?;
                let address = server.address();
                running.push(server);
                narrator.step("started", format_args!("environment server at {address}"))?;
                address
            }
        };
        let access = &args.store.access;
        // What this command has started asks for nothing.
        let options = match &args.store.addr {
            Some(address) => access.options(address)?,
            None => ConnectOptions::default(),
        };
        let learner = Learner::connect_with(&learner_address, &options).await.map_err(|error| {
            unreachable(&error, format!("start one with 'learner serve --listen {learner_address}'"))
        })?;
        let options = match args.env_addr.as_ref().or(args.store.addr.as_ref()) {
            Some(_) => access.options(&environments_address)?,
            None => ConnectOptions::default(),
        };
        // An imported environment needs none: it is an error only once it is asked for.
        let environments = Connection::connect(&environments_address, &options).await.map_err(|error| {
            unreachable(
                &error,
                format!("start one with 'server --listen {environments_address}', or name another with --env-addr"),
            )
        });
        if args.store.addr.is_some() {
            let there = if environments.is_ok() { &environments_address } else { "nowhere" };
            narrator.step("connected", format_args!("learner at {learner_address}, environments at {there}"))?;
        }
        Ok(Self { environments, learner, data, embedded: running })
    }

    /// Stops what was started, and waits until all that it accepted is on stable storage.
    ///
    /// # Errors
    /// One of them failed meanwhile.
    pub async fn stop(self) -> Result<(), CliError> {
        drop((self.environments, self.learner));
        for service in self.embedded {
            service.stop().await?;
        }
        Ok(())
    }

    pub fn environments(&self) -> Result<&Connection, CliError> {
        self.environments.as_ref().map_err(Clone::clone)
    }

    /// The learner.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }

    /// Whether the learner knows a model of the environment.
    ///
    /// # Errors
    /// The learner fails.
    pub async fn imported(&self, env_id: &str) -> Result<bool, CliError> {
        Ok(!self.learner.list_models(env_id).await?.is_empty())
    }

    /// Directory of reports.
    pub fn data(&self) -> &Path {
        &self.data
    }

    /// Description of an environment.
    ///
    /// # Errors
    /// There is none of that name.
    pub async fn spec(&self, env_id: &str) -> Result<EnvSpec, CliError> {
        scene::spec(self.environments()?, env_id).await
    }

    /// The environment's tabular model.
    ///
    /// # Errors
    /// Wrong options; the server fails.
    pub async fn model(&self, job: &Job, spec: &EnvSpec) -> Result<Model, CliError> {
        scene::model(self.environments()?, spec, &job.env_options).await
    }

    /// Keeps a model in the learner.
    ///
    /// # Errors
    /// The learner refuses it.
    pub async fn put_model(&self, model: &Model) -> Result<(), CliError> {
        match self.learner.put_model(model).await {
            // Somebody described the same process in another way, with features perhaps: that stays.
            Err(error) if error.code() == Code::AlreadyExists => Ok(()),
            outcome => Ok(outcome.map(|_| ())?),
        }
    }

    /// Has the server drive; tells of episodes as they come.
    ///
    /// # Errors
    /// The server refuses or fails.
    pub async fn rollout(&self, rollout: Rollout, mut arrived: impl FnMut(u64)) -> Result<Episodes, CliError> {
        let stream = self.environments()?.rollout_stream(rollout).await?;
        Ok(stream.collect_with(|episodes| arrived(episodes.len() as u64)).await?)
    }

    /// An environment to step.
    ///
    /// # Errors
    /// The server refuses.
    pub async fn env(&self, env_id: &str, options: SessionOptions) -> Result<Env, CliError> {
        Ok(Env::create(self.environments()?, env_id, options).await?)
    }

    /// The trajectories that a fit used, in the order used.
    ///
    /// # Errors
    /// The learner fails, or has lost one.
    pub async fn trajectories(&self, fit: &Fit) -> Result<Vec<mazeway_learner::trajectory::Trajectory>, CliError> {
        let mut found = Vec::new();
        let mut stream = self.learner.export_fit_trajectories(&fit.fit_id, &TrajectoryFilter::default()).await?;
        while let Some(part) = stream.next().await? {
            for trajectory in part {
                found.push(checked(&trajectory)?);
            }
        }
        if found.len() as u64 == fit.trajectories {
            return Ok(found);
        }
        Err(CliError::failure("the trajectories of the fit are gone", "see what is stored with 'learner list'"))
    }

    /// How many recordings a filter selects.
    ///
    /// # Errors
    /// The learner fails.
    pub async fn count(&self, filter: &TrajectoryFilter) -> Result<u64, CliError> {
        Ok(self.learner.count_trajectories(filter).await?)
    }

    /// Records; returns how many were not stored before, once all are on stable storage.
    ///
    /// # Errors
    /// The learner refuses one or fails.
    pub async fn record(
        &self,
        trajectories: Vec<Trajectory>,
        mut acknowledged: impl FnMut(u64),
    ) -> Result<u64, CliError> {
        let mut recorder = self.learner.recorder();
        for trajectory in trajectories {
            recorder.record(trajectory).await?;
            acknowledged(recorder.receipt().acknowledged());
        }
        Ok(recorder.finish().await?.stored)
    }

    /// Fits.
    ///
    /// # Errors
    /// The learner refuses or fails.
    pub async fn fit(&self, request: FitRequest, follow: impl FnMut(&Event)) -> Result<Fit, CliError> {
        self.learner.fit_following(request, follow).await.map_err(|error| match error.field() {
            Some(field) if field.starts_with("options") => {
                CliError::usage(error.to_string(), "see 'learner fit --help' for what each option takes")
            }
            _ => error.into(),
        })
    }
}

/// Where the recordings that a fit used came from, and how many from each, by name.
pub fn sources(fit: &Fit) -> Vec<Source> {
    let mut sources: Vec<Source> =
        fit.sources.iter().map(|s| Source { name: s.source.clone(), trajectories: s.trajectories }).collect();
    sources.sort_by(|a, b| a.name.cmp(&b.name));
    sources
}

/// A trajectory as the mathematics takes it.
///
/// # Errors
/// Its arrays are torn, or it is none.
pub fn checked(trajectory: &Trajectory) -> Result<mazeway_learner::trajectory::Trajectory, CliError> {
    let broken = |message: String| {
        CliError::failure(message, "the learner is of another release, or its data directory is damaged")
    };
    let array = |bytes: &prost::bytes::Bytes| {
        Packed::<u32>::new(bytes.clone())
            .map(|packed| packed.to_vec())
            .ok_or_else(|| broken(format!("trajectory {} has a torn array", trajectory.trajectory_id)))
    };
    let (states, actions) = (array(&trajectory.states)?, array(&trajectory.actions)?);
    let checked = if actions.is_empty() {
        mazeway_learner::trajectory::Trajectory::states_only(states, trajectory.final_state, trajectory.n_states)
    } else {
        mazeway_learner::trajectory::Trajectory::new(
            states,
            actions,
            trajectory.final_state,
            trajectory.n_states,
            trajectory.n_actions,
        )
    };
    checked.map_err(|error| broken(format!("trajectory {}: {error}", trajectory.trajectory_id)))
}

/// The same host at the environment server's usual port.
fn beside(learner: &str) -> String {
    match learner.rsplit_once(':') {
        Some((host, _)) => format!("{host}:{ENVIRONMENTS_PORT}"),
        None => format!("{learner}:{ENVIRONMENTS_PORT}"),
    }
}

#[cfg(test)]
mod tests {
    use super::beside;

    #[test]
    fn the_environment_server_lives_beside_the_learner() {
        assert_eq!(beside("127.0.0.1:50052"), "127.0.0.1:50051");
        assert_eq!(beside("[::1]:7"), "[::1]:50051");
        assert_eq!(beside("http://robots.example:50052"), "http://robots.example:50051");
    }
}
