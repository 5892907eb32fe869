//! Steps beside fits: a learner that fits without end, on the cores that the server has, and a client that steps.

use crate::{
    probe::{self, Waits},
    report::waits_table,
    run::Plan,
    server::{Echo, Learner, Server},
};
use mazeway_client::{ClientError, Demonstration, Learner as Client, packed::pack};
use mazeway_proto::{
    env::{ModelHeader, ModelPart, RowBlock, model_part::Part},
    learner::{FitOptions, FitRequest, TrajectoryFilter, fit_response::Event},
};
use serde_json::{Value, json};
use std::{
    convert::Infallible,
    fmt::Write as _,
    io,
    path::Path,
    sync::mpsc::{self, Sender},
    thread,
    time::{Duration, Instant},
};

/// Fits at a time: as many as a learner runs by default.
const FITS: usize = 2;
/// States of the model, all of which lead everywhere: an iteration of a fit takes a while.
const STATES: u32 = 500;
const ACTIONS: u32 = 4;
/// Cores that fits use at least while steps are timed: with less, they were not there.
const LEAST_BUSY: f64 = 0.1;
/// Longest until all fits are under way.
const PATIENCE: Duration = Duration::from_mins(2);

/// What was seen.
#[derive(Debug, Clone)]
pub struct Report {
    bare: Waits,
    alone: Waits,
    beside: Waits,
    /// Cores that the learner used meanwhile.
    learner_busy: f64,
    pinned: bool,
    /// The client that was timed ran before all else on its core.
    ahead: bool,
}

impl Report {
    /// The p99 of a step beside fits, in medians of one without.
    pub fn ratio(&self) -> f64 {
        self.beside.p99 / self.alone.median
    }

    /// Where it is not what it should be: a median step beside fits of `most_medians` without is what it should be. What the
    /// p99 is, is the scheduler's to say, which lets a thread of fits end its slice of some milliseconds now and then.
    pub fn missed(&self, most_medians: f64) -> Vec<String> {
        let ratio = self.beside.median / self.alone.median;
        let mut missed = Vec::new();
        if ratio > most_medians {
            missed.push(format!("median beside fits: expected at most {most_medians} without, got {ratio:.1}"));
        }
        if self.learner_busy < LEAST_BUSY {
            missed
                .push(format!("fits: expected them to use {LEAST_BUSY} cores at least, got {:.2}", self.learner_busy));
        }
        missed
    }

    /// One object for programs.
    pub fn to_json(&self) -> Value {
        json!({
            "benchmark": "soak-fits", "pinned": self.pinned, "ahead": self.ahead, "bare": self.bare.to_json(), "alone": self.alone.to_json(),
            "beside_fits": self.beside.to_json(), "ratio": self.ratio(), "learner_busy_cores": self.learner_busy,
        })
    }

    /// A table for people.
    pub fn tables(&self) -> String {
        let rows =
            [("bare socket, without fits", &self.bare), ("without fits", &self.alone), ("beside fits", &self.beside)];
        let mut text = waits_table(&rows);
        let (ratio, median, p99, busy) = (self.ratio(), self.alone.median, self.beside.p99, self.learner_busy);
        let _ = writeln!(
            text,
            "p99 beside {FITS} fits is {p99:.0} µs, {ratio:.1} times the median without of {median:.0} µs; the fits \
             used {busy:.2} cores"
        );
        text
    }
}

/// Steps without fits and beside them.
///
/// # Errors
/// A program does not run; the fits do not begin.
pub fn run(plan: &Plan, learner: &Path) -> io::Result<Report> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (server, learner) = (Server::start(&plan.server, plan.pinned)?, Learner::start(learner, plan.pinned)?);
    let ahead = plan.take_place()?;
    let bare = {
        let echo = Echo::start(&plan.soak, plan.pinned)?;
        runtime.block_on(probe::echo(&echo.address, plan.quiet()))?
    };
    let alone = runtime.block_on(probe::act(&server.address, plan.time, || ()));
    let (begun, begins) = mpsc::channel();
    let address = learner.address.clone();
    // They end when the learner does.
    let fits = thread::spawn(move || fit(&address, &begun));
    for _ in 0..FITS {
        if begins.recv_timeout(PATIENCE).is_err() {
            drop(learner);
            let ended = fits.join().unwrap_or_else(|_| Err(io::Error::other("the fits panicked")));
            return Err(ended.err().unwrap_or_else(|| io::Error::other("the fits did not begin")));
        }
    }
    let (since, processor) = (Instant::now(), learner.processor_secs()?);
    let beside = runtime.block_on(probe::act(&server.address, plan.time, || ()));
    let learner_busy = (learner.processor_secs()? - processor) / since.elapsed().as_secs_f64();
    drop(learner);
    let _ = fits.join();
    Ok(Report { bare, alone, beside, learner_busy, pinned: plan.pinned, ahead })
}

/// Has a learner fit until it is no more; tells of every fit that begins.
fn fit(address: &str, begun: &Sender<()>) -> io::Result<Infallible> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(fit_all(address, begun)).map_err(|error| io::Error::other(error.to_string()))
}

async fn fit_all(address: &str, begun: &Sender<()>) -> Result<Infallible, ClientError> {
    let learner = Client::connect(address).await?;
    let request = prepare(&learner).await?;
    let one = || without_end(&learner, &request, begun);
    let (never, _) = tokio::try_join!(one(), one())?;
    Ok(never)
}

/// Fits, and when it is done again.
async fn without_end(learner: &Client, request: &FitRequest, begun: &Sender<()>) -> Result<Infallible, ClientError> {
    loop {
        let mut is_new = true;
        let follow = |event: &Event| {
            if matches!(event, Event::Progress(_)) && std::mem::take(&mut is_new) {
                // Nobody may listen any more.
                let _ = begun.send(());
            }
        };
        learner.fit_following(request.clone(), follow).await?;
    }
}

/// Stores a model and a demonstration, and gives what to ask for: without a penalty the likelihood of what was never seen has
/// no maximum, so that a fit goes on for as long as it may.
async fn prepare(learner: &Client) -> Result<FitRequest, ClientError> {
    let model_id = learner.put_model_parts(model()).await?.model_id;
    let mut recorder = learner.recorder();
    let demonstration = Demonstration {
        env_id: "Everywhere-v0".into(),
        model_id,
        style: "wandering".into(),
        n_states: STATES,
        n_actions: ACTIONS,
        states: (0..200).map(|step| step * 7 % STATES).collect(),
        actions: (0..200).map(|step| step * step % ACTIONS).collect(),
        ..Demonstration::default()
    };
    recorder.record(demonstration).await?;
    recorder.finish().await?;
    Ok(FitRequest {
        method: "em-tied".into(),
        filter: Some(TrajectoryFilter { style: "wandering".into(), ..TrajectoryFilter::default() }),
        options: Some(FitOptions {
            basis: mazeway_proto::learner::Basis::StateAction as i32,
            penalty: mazeway_proto::learner::Penalty::None as i32,
            tolerance: Some(0.0),
            max_iterations: Some(1_000_000),
            ..FitOptions::default()
        }),
        ..FitRequest::default()
    })
}

/// A model in which every state leads to every other, more likely to those that follow it.
fn model() -> Vec<ModelPart> {
    let header =
        ModelHeader { env_id: "Everywhere-v0".into(), n_states: STATES, n_actions: ACTIONS, ..ModelHeader::default() };
    let rows = |state: u32| {
        let weight = |action: u32, next: u32| 1.0 + f64::from((next + STATES - state) * (action + 1) % STATES);
        let probabilities = (0..ACTIONS).flat_map(|action| {
            let sum = (0..STATES).map(|next| weight(action, next)).sum::<f64>();
            (0..STATES).map(move |next| weight(action, next) / sum)
        });
        RowBlock {
            first_row: state * ACTIONS,
            row_lengths: pack(vec![STATES; ACTIONS as usize]),
            next_states: pack((0..ACTIONS).flat_map(|_| 0..STATES)),
            probabilities: pack(probabilities),
            ..RowBlock::default()
        }
    };
    let parts = [Part::Header(header)].into_iter().chain((0..STATES).map(|state| Part::Rows(rows(state))));
    parts.map(|part| ModelPart { part: Some(part) }).collect()
}
