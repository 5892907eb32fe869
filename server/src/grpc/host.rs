//! What every call of a server shares.

use super::{numbers::Numbers, status::CallError, watch::Gallery};
use crate::{
    batch::{BatchOptions, Layout},
    config::Config,
    grpc::from_proto::{self, NewSession, RolloutLimits},
    registry::{Environment, Options, Registry},
    rollout::RolloutPlan,
    sessions::{Guard, Holder, SessionId, Sessions},
    sim::TabularModel,
};
use mazeway_proto::env as pb;
use mazeway_serving::{Caller, Telemetry};
use std::{
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

/// One server: its catalogue, its sessions, its limits.
pub struct Host {
    pub config: Config,
    pub registry: Registry,
    pub sessions: Arc<Sessions>,
    pub numbers: Numbers,
    /// A permit a running roll-out.
    pub rollouts: Arc<Semaphore>,
    /// A permit a model that is looked up or computed.
    models: Semaphore,
    /// Who watches what.
    pub gallery: Gallery,
    /// Cancelled when the server is told to stop.
    pub shutdown: CancellationToken,
    /// Cancelled shortly before calls that still run are cut off.
    pub last_words: CancellationToken,
}

impl Host {
    pub fn new(config: Config, telemetry: &Telemetry, shutdown: CancellationToken) -> Self {
        let sessions = Arc::new(Sessions::new(config.limits()));
        Self {
            registry: Registry::new(),
            numbers: Numbers::new(telemetry, &sessions),
            sessions,
            rollouts: Arc::new(Semaphore::new(config.max_concurrent_rollouts.min(Semaphore::MAX_PERMITS))),
            models: Semaphore::new(config.max_concurrent_models.clamp(1, Semaphore::MAX_PERMITS)),
            gallery: Gallery::default(),
            config,
            shutdown,
            last_words: CancellationToken::new(),
        }
    }

    /// Creates a session, and says which it is and how long its lease.
    pub fn create_session(
        self: &Arc<Self>,
        caller: &Caller,
        asked: &NewSession,
    ) -> Result<(Guard, Duration), CallError> {
        self.try_create_session(caller, asked).inspect_err(|error| self.numbers.refused(error))
    }

    fn try_create_session(
        self: &Arc<Self>,
        caller: &Caller,
        asked: &NewSession,
    ) -> Result<(Guard, Duration), CallError> {
        if self.shutdown.is_cancelled() {
            return Err(CallError::ShuttingDown);
        }
        let environment = self.registry.configure(&asked.env_id, &asked.options)?;
        let spec = environment.spec();
        let options = BatchOptions {
            num_envs: asked.num_envs,
            autoreset: asked.autoreset,
            max_episode_steps: asked.max_episode_steps.unwrap_or(spec.max_episode_steps),
            action_masks: asked.action_masks,
        };
        let (reply_bytes, limit) = (Layout::of(spec, options).total_len(), self.config.max_message_bytes);
        if reply_bytes > limit {
            let what = "bytes in a reply";
            return Err(CallError::Limit { field: "num_envs", what, limit: limit as u64, asked: reply_bytes as u64 });
        }
        let now = Instant::now();
        let make = || Arc::clone(&environment).batch(options);
        let (id, lease) = self.sessions.create(&holder(caller), asked.num_envs, asked.lease, now, make)?;
        tracing::debug!(session = ?id, env_id = spec.env_id, num_envs = asked.num_envs, ?lease, "session created");
        Ok((self.sessions.take(id, caller.name(), now, None)?, lease))
    }

    /// Configures the environment of a roll-out and checks the plan.
    pub fn plan_rollout(
        &self,
        mut request: pb::RolloutRequest,
    ) -> Result<(Arc<dyn Environment>, RolloutPlan), CallError> {
        let options = from_proto::options(request.options.take())?;
        let environment = self.registry.configure(&request.env_id, &options)?;
        let limits = RolloutLimits {
            max_steps: self.config.max_rollout_steps,
            max_message_bytes: self.config.max_message_bytes,
        };
        let plan = from_proto::rollout(&request, environment.spec(), &limits)?;
        Ok((environment, plan))
    }

    /// Takes a session of the caller for one call.
    pub fn take(self: &Arc<Self>, caller: &Caller, id: SessionId) -> Result<Guard, CallError> {
        Ok(self.sessions.take(id, caller.name(), Instant::now(), None)?)
    }

    /// The tabular model of an environment, once there is a thread to compute it on.
    pub async fn model(self: &Arc<Self>, env_id: String, options: Options) -> Result<Arc<TabularModel>, CallError> {
        let _permit = self.models.acquire().await.map_err(|_| CallError::ShuttingDown)?;
        let host = Arc::clone(self);
        blocking(move || Ok(host.registry.model(&env_id, &options)?)).await
    }

    /// Ends expired sessions until the server stops.
    pub async fn reap_sessions(self: Arc<Self>) {
        let pause = (self.config.default_lease / 4).clamp(Duration::from_millis(10), Duration::from_secs(1));
        loop {
            tokio::select! {
                () = self.shutdown.cancelled() => return,
                () = tokio::time::sleep(pause) => {}
            }
            let ended = self.sessions.reap(Instant::now());
            if ended > 0 {
                tracing::info!(ended, "sessions expired");
            }
        }
    }
}

/// A caller as the holder of sessions.
pub fn holder(caller: &Caller) -> Holder {
    let quotas = caller.quotas();
    Holder { name: caller.name().into(), max_sessions: quotas.max_sessions, max_envs: quotas.max_envs }
}

/// Runs work that takes a while off the async threads.
pub async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, CallError> + Send + 'static,
) -> Result<T, CallError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| CallError::Internal(error.to_string()))?
}
