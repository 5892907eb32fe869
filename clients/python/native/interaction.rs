//! The fast path: one session's stream, from Python's actions to numpy arrays.

use crate::{
    arrays::{Column, Scalars, flags, shaped},
    channel::{Channel, Link, seconds},
    driver::Local,
    errors::Failure,
};
use mazeway_client::{EnvSpec, Infos, Observations, ResetBatch, Seeds, StepBatch, VectorEnv, spec::ObservationSpace};
use mazeway_proto::env::CreateSessionResponse;
use numpy::{PyArray1, PyArrayMethods as _, PyUntypedArrayMethods as _};
use prost::Message as _;
use pyo3::{
    IntoPyObjectExt as _,
    exceptions::PyValueError,
    prelude::*,
    types::{PyDict, PyList},
};
use std::{sync::Arc, time::Duration};
use tokio::sync::Mutex;

/// How long a stream that ended while nobody looked is tried to be opened anew, unless the answer would be late before: the
/// next one says what was wrong. To make a lost session anew is for Python.
const RESUME: Duration = Duration::from_secs(10);

/// Observations, info columns.
type First = (Py<PyAny>, Py<PyList>);
/// Observations, rewards, terminated, truncated, info columns, and the last observations and columns where episodes ended.
type Stepped = (Py<PyAny>, Py<PyAny>, Py<PyAny>, Py<PyAny>, Py<PyList>, Option<First>);
/// Observation, reward, terminated, truncated, info.
type SteppedOne = (Py<PyAny>, f64, bool, bool, Py<PyDict>);

/// What the session is asked.
enum Ask {
    Reset(Seeds, Option<Vec<bool>>),
    Step(Vec<u32>),
    Send(Vec<u32>),
    Receive,
    Close,
}

/// What it says.
enum Said {
    First(ResetBatch),
    Stepped(StepBatch),
    Nothing,
}

impl Said {
    fn first(self) -> Result<ResetBatch, Failure> {
        match self {
            Self::First(batch) => Ok(batch),
            _ => Err(Failure::protocol("expected first observations")),
        }
    }

    fn stepped(self) -> Result<StepBatch, Failure> {
        match self {
            Self::Stepped(batch) => Ok(batch),
            _ => Err(Failure::protocol("expected what came of a step")),
        }
    }
}

/// The stream of a session; opened with its first use.
#[pyclass(frozen, module = "mazeway._native")]
#[derive(Debug)]
pub struct Interaction {
    inner: Local<Inner>,
    layout: Layout,
}

#[derive(Debug)]
struct Inner {
    link: Arc<Link>,
    created: CreateSessionResponse,
    env: Mutex<Option<VectorEnv>>,
    timeout: Duration,
}

impl Inner {
    fn ask(&self, py: Python<'_>, ask: Ask) -> PyResult<Said> {
        self.ask_within(py, self.timeout, ask)
    }

    fn ask_within(&self, py: Python<'_>, timeout: Duration, ask: Ask) -> PyResult<Said> {
        self.link.driver.catch_up(py);
        Ok(self.link.driver.wait(py, timeout, self.answer(ask))??)
    }

    async fn answer(&self, ask: Ask) -> Result<Said, Failure> {
        let mut slot = self.env.lock().await;
        let env = if let Some(env) = &mut *slot {
            env
        } else {
            let connection = self.link.dial.connection().await?;
            let resume_within = self.timeout.mul_f64(0.8).min(RESUME);
            slot.insert(VectorEnv::attach(&connection, self.created.clone(), Some(resume_within))?)
        };
        Ok(match ask {
            Ask::Reset(seeds, None) => Said::First(env.reset(seeds).await?),
            Ask::Reset(seeds, Some(mask)) => Said::First(env.reset_some(seeds, &mask).await?),
            Ask::Step(actions) => Said::Stepped(env.step(&actions).await?),
            Ask::Receive => Said::Stepped(env.receive_step().await?),
            Ask::Send(actions) => {
                env.send_step(&actions).await?;
                Said::Nothing
            }
            Ask::Close => {
                env.close().await?;
                Said::Nothing
            }
        })
    }
}

/// How the session's arrays look.
#[derive(Debug)]
struct Layout {
    num_envs: usize,
    n_actions: u32,
    /// Of one observation; empty where the space is discrete.
    shape: Vec<usize>,
    columns: Vec<Column>,
    scalars: Option<Scalars>,
}

impl Layout {
    fn infos(&self, py: Python<'_>, infos: &Infos) -> PyResult<Py<PyList>> {
        let columns: Result<Vec<_>, Failure> =
            self.columns.iter().map(|column| column.batch(py, infos, self.num_envs)).collect();
        Ok(PyList::new(py, columns?)?.unbind())
    }

    fn info(&self, py: Python<'_>, infos: &Infos) -> PyResult<Py<PyDict>> {
        let info = PyDict::new(py);
        for column in &self.columns {
            column.insert(&info, infos)?;
        }
        Ok(info.unbind())
    }

    /// Shape `(num_envs, ...)`: int64 where the space is discrete, else float32.
    fn observations(&self, py: Python<'_>, observations: &Observations) -> Result<Py<PyAny>, Failure> {
        match observations {
            Observations::Discrete(values) => shaped(py, values.iter().map(i64::from).collect(), &[self.num_envs]),
            Observations::Box { values, .. } => {
                let shape: Vec<_> = [self.num_envs].iter().chain(&self.shape).copied().collect();
                shaped(py, values.to_vec(), &shape)
            }
        }
    }

    fn observation(&self, py: Python<'_>, observations: &Observations) -> PyResult<Py<PyAny>> {
        match (observations, &self.scalars) {
            (Observations::Discrete(values), Some(scalars)) => scalars.get(py, values.get(0).unwrap_or_default()),
            (Observations::Box { values, .. }, None) => Ok(shaped(py, values.to_vec(), &self.shape)?),
            _ => Err(Failure::protocol("expected observations of the session's space").into()),
        }
    }

    fn first(&self, py: Python<'_>, batch: &ResetBatch) -> PyResult<First> {
        Ok((self.observations(py, &batch.observations)?, self.infos(py, &batch.infos)?))
    }

    fn stepped(&self, py: Python<'_>, batch: &StepBatch) -> PyResult<Stepped> {
        Ok((
            self.observations(py, &batch.observations)?,
            PyArray1::from_vec(py, batch.rewards.to_vec()).into_py_any(py)?,
            flags(py, batch.terminated.as_bytes()),
            flags(py, batch.truncated.as_bytes()),
            self.infos(py, &batch.infos)?,
            batch.last.as_ref().map(|last| self.first(py, last)).transpose()?,
        ))
    }

    /// Actions as they travel, from a contiguous int64 array of the right shape; the server knows which of them there are.
    fn actions(&self, actions: &Bound<'_, PyArray1<i64>>) -> PyResult<Vec<u32>> {
        if actions.len() != self.num_envs {
            let message = format!("actions: expected shape ({},), got ({},)", self.num_envs, actions.len());
            return Err(Failure::argument("actions", message).into());
        }
        let actions = actions.try_readonly()?;
        let actions = actions.as_slice()?;
        let (low, high) = actions.iter().fold((0, 0), |(low, high), &action| (action.min(low), action.max(high)));
        let range = i64::from(i32::MIN)..=i64::from(i32::MAX);
        if let Some(wrong) = [low, high].into_iter().find(|value| !range.contains(value)) {
            let message = format!("actions: expected values from {} to {}, got {wrong}", range.start(), range.end());
            return Err(Failure::argument("actions", message).into());
        }
        Ok(actions.iter().map(|&action| action as i32 as u32).collect())
    }
}

#[pymethods]
impl Interaction {
    /// Takes what the server said when the session was made, packed.
    #[new]
    fn new(py: Python<'_>, channel: &Channel, created: &[u8], timeout: f64) -> PyResult<Self> {
        let created =
            CreateSessionResponse::decode(created).map_err(|error| PyValueError::new_err(error.to_string()))?;
        let link = Arc::clone(channel.link()?);
        let spec = EnvSpec::try_from(created.spec.clone().unwrap_or_default()).map_err(Failure::from)?;
        let (shape, scalars) = match &spec.observation_space {
            ObservationSpace::Discrete { n } => (Vec::new(), Some(Scalars::new(py, *n)?)),
            ObservationSpace::Box { shape, .. } => (shape.iter().map(|&n| n as usize).collect(), None),
        };
        let layout = Layout {
            num_envs: created.num_envs as usize,
            n_actions: spec.n_actions,
            shape,
            columns: spec.info_columns.iter().map(|column| Column::new(py, column)).collect(),
            scalars,
        };
        let env = Mutex::new(None);
        Ok(Self { inner: Local::new(Inner { link, created, env, timeout: seconds(timeout) }), layout })
    }

    /// Begins episodes: with `seeds`, else with `seed` + i, else the generators go on; all, or those of `mask`.
    #[pyo3(signature = (seed=None, seeds=None, mask=None))]
    fn reset(
        &self,
        py: Python<'_>,
        seed: Option<u64>,
        seeds: Option<Vec<u64>>,
        mask: Option<Vec<bool>>,
    ) -> PyResult<First> {
        let seeds = seeds.map_or_else(|| seed.map_or(Seeds::Continue, Seeds::From), Seeds::Each);
        let said = self.inner.get()?.ask(py, Ask::Reset(seeds, mask))?;
        self.layout.first(py, &said.first()?)
    }

    /// Steps every environment.
    fn step(&self, py: Python<'_>, actions: &Bound<'_, PyArray1<i64>>) -> PyResult<Stepped> {
        let actions = self.layout.actions(actions)?;
        let said = self.inner.get()?.ask(py, Ask::Step(actions))?;
        self.layout.stepped(py, &said.stepped()?)
    }

    /// Sends actions without waiting for what comes of them.
    fn send(&self, py: Python<'_>, actions: &Bound<'_, PyArray1<i64>>) -> PyResult<()> {
        let actions = self.layout.actions(actions)?;
        let inner = self.inner.get()?;
        inner.ask(py, Ask::Send(actions))?;
        inner.link.driver.settle(py);
        Ok(())
    }

    /// What came of the oldest actions that were sent and not yet received.
    fn receive(&self, py: Python<'_>) -> PyResult<Stepped> {
        let said = self.inner.get()?.ask(py, Ask::Receive)?;
        self.layout.stepped(py, &said.stepped()?)
    }

    /// As `reset`, for a session of one environment: its observation and info.
    #[pyo3(signature = (seed=None))]
    fn reset_one(&self, py: Python<'_>, seed: Option<u64>) -> PyResult<(Py<PyAny>, Py<PyDict>)> {
        let seeds = seed.map_or(Seeds::Continue, Seeds::From);
        let batch = self.inner.get()?.ask(py, Ask::Reset(seeds, None))?.first()?;
        Ok((self.layout.observation(py, &batch.observations)?, self.layout.info(py, &batch.infos)?))
    }

    /// As `step`, for a session of one environment; None for what is none of its actions.
    fn step_one(&self, py: Python<'_>, action: &Bound<'_, PyAny>) -> PyResult<Option<SteppedOne>> {
        let action = action.extract::<u32>().ok().filter(|&action| action < self.layout.n_actions);
        let Some(action) = action else { return Ok(None) };
        let batch = self.inner.get()?.ask(py, Ask::Step(vec![action]))?.stepped()?;
        Ok(Some((
            self.layout.observation(py, &batch.observations)?,
            batch.rewards.get(0).unwrap_or_default(),
            batch.terminated.get(0) == Some(1),
            batch.truncated.get(0) == Some(1),
            self.layout.info(py, &batch.infos)?,
        )))
    }

    /// Ends the session.
    fn close(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        self.inner.get()?.ask_within(py, seconds(timeout), Ask::Close)?;
        Ok(())
    }
}
