//! `learner list`: what is stored.

use super::{
    StoreArgs,
    connect::connect,
    error::CliError,
    table::{short, table, time},
};
use clap::Args;
use mazeway_client::Learner;
use mazeway_proto::learner as pb;
use serde::Serialize;
use std::{collections::BTreeMap, io::Write as _};

/// What to list.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Every trajectory, rather than how many there are of each kind
    #[arg(long)]
    trajectories: bool,
    /// Models alone
    #[arg(long)]
    models: bool,
    /// Fits alone
    #[arg(long)]
    fits: bool,
    /// Of this environment alone
    #[arg(long, value_name = "ENV", default_value = "", hide_default_value = true)]
    env: String,
    /// Of this style alone
    #[arg(long, value_name = "STYLE", default_value = "", hide_default_value = true)]
    style: String,
    /// One JSON object on standard output
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    store: StoreArgs,
}

/// Recordings that have everything but their seed in common.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Kind {
    env: String,
    style: String,
    source: String,
    model: String,
}

/// How many there are of a kind.
#[derive(Debug, Default, Serialize)]
struct Tally {
    trajectories: u64,
    steps: u64,
    first: String,
    last: String,
}

#[derive(Debug, Serialize)]
struct Group {
    #[serde(flatten)]
    kind: Kind,
    #[serde(flatten)]
    tally: Tally,
}

#[derive(Debug, Serialize)]
struct TrajectoryRow {
    id: String,
    env: String,
    style: String,
    source: String,
    model: String,
    seed: Option<u64>,
    steps: u32,
    recorded_at: String,
}

#[derive(Debug, Serialize)]
struct ModelRow {
    id: String,
    env: String,
    n_states: u32,
    n_actions: u32,
    n_transitions: u64,
    estimated: bool,
    styles: Vec<String>,
    features: Vec<String>,
    stored_at: String,
}

#[derive(Debug, Serialize)]
struct FitRow {
    id: String,
    env: String,
    style: String,
    method: String,
    model: String,
    trajectories: u32,
    stopped: String,
    iterations: u32,
    agreement: f64,
    created_at: String,
}

/// What was asked for; what was not is left out.
#[derive(Debug, Default, Serialize)]
struct Listing {
    #[serde(skip_serializing_if = "Option::is_none")]
    recordings: Option<Vec<Group>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trajectories: Option<Vec<TrajectoryRow>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    models: Option<Vec<ModelRow>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fits: Option<Vec<FitRow>>,
}

/// Lists.
pub async fn run(args: ListArgs) -> Result<(), CliError> {
    let connected = connect(&args.store).await?;
    let listing = ask(&args, &connected.learner).await;
    let listing = connected.finish(listing).await?;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string(&listing).map_err(std::io::Error::from)?)?;
    } else {
        write!(out, "{}", text(&args, &listing))?;
    }
    Ok(out.flush()?)
}

async fn ask(args: &ListArgs, learner: &Learner) -> Result<Listing, CliError> {
    let all = !(args.trajectories || args.models || args.fits);
    let mut listing = Listing::default();
    if all || args.trajectories {
        let filter = pb::TrajectoryFilter { env_id: args.env.clone(), style: args.style.clone(), ..Default::default() };
        if args.trajectories {
            let rows = learner.list_trajectories(&filter).await?;
            listing.trajectories = Some(rows.into_iter().map(trajectory_row).collect());
        } else {
            listing.recordings = Some(groups(learner, &filter).await?);
        }
    }
    if all || args.models {
        let models = learner.list_models(&args.env).await?.into_iter();
        let models = models.filter(|m| args.style.is_empty() || m.styles.contains(&args.style));
        listing.models = Some(models.map(model_row).collect());
    }
    if all || args.fits {
        let fits = learner.list_fits(&args.env, &args.style).await?;
        listing.fits = Some(fits.into_iter().map(fit_row).collect());
    }
    Ok(listing)
}

/// Counts page by page: a store may hold more trajectories than memory should.
async fn groups(learner: &Learner, filter: &pb::TrajectoryFilter) -> Result<Vec<Group>, CliError> {
    let mut tallies = BTreeMap::<Kind, Tally>::new();
    let mut token = String::new();
    loop {
        let page = learner.list_trajectories_page(filter, 10_000, &token).await?;
        for t in page.trajectories {
            let kind = Kind { env: t.env_id, style: t.style, source: t.source, model: t.model_id };
            let tally = tallies.entry(kind).or_default();
            tally.trajectories += 1;
            tally.steps += u64::from(t.steps);
            tally.last = time(t.recorded_at);
            if tally.first.is_empty() {
                tally.first.clone_from(&tally.last);
            }
        }
        if page.next_page_token.is_empty() {
            return Ok(tallies.into_iter().map(|(kind, tally)| Group { kind, tally }).collect());
        }
        token = page.next_page_token;
    }
}

fn trajectory_row(t: pb::TrajectorySummary) -> TrajectoryRow {
    TrajectoryRow {
        id: t.trajectory_id,
        env: t.env_id,
        style: t.style,
        source: t.source,
        model: t.model_id,
        seed: t.seed,
        steps: t.steps,
        recorded_at: time(t.recorded_at),
    }
}

fn model_row(m: pb::ModelSummary) -> ModelRow {
    ModelRow {
        id: m.model_id,
        env: m.env_id,
        n_states: m.n_states,
        n_actions: m.n_actions,
        n_transitions: m.n_transitions,
        estimated: m.estimated,
        styles: m.styles,
        features: m.features,
        stored_at: time(m.stored_at),
    }
}

fn fit_row(f: pb::FitSummary) -> FitRow {
    FitRow {
        id: f.fit_id,
        env: f.env_id,
        style: f.style,
        method: f.method,
        model: f.model_id,
        trajectories: f.trajectories,
        stopped: stopped(f.stopped).into(),
        iterations: f.iterations,
        agreement: f.agreement,
        created_at: time(f.created_at),
    }
}

/// How a fit stopped, in words.
pub fn stopped(stopped: i32) -> &'static str {
    match pb::Stopped::try_from(stopped) {
        Ok(pb::Stopped::Converged) => "converged",
        Ok(pb::Stopped::MaxIterations) => "max-iterations",
        Ok(pb::Stopped::Stalled) => "stalled",
        Ok(pb::Stopped::ClosedForm) => "closed-form",
        Ok(pb::Stopped::Unspecified) | Err(_) => "unknown",
    }
}

fn text(args: &ListArgs, listing: &Listing) -> String {
    let mut parts = Vec::new();
    let mut section = |title: &str, rows: usize, table: &dyn Fn() -> String, none: &str| {
        parts.push(if rows == 0 { format!("{title}: {none}\n") } else { format!("{title}\n{}\n", table()) });
    };
    let which = match (args.env.as_str(), args.style.as_str()) {
        ("", "") => String::new(),
        (env, "") => format!(" for {env}"),
        ("", style) => format!(" of style '{style}'"),
        (env, style) => format!(" for {env} of style '{style}'"),
    };
    if let Some(groups) = &listing.recordings {
        let rows = || {
            table(
                ["environment", "style", "source", "model", "#trajectories", "#steps", "first", "last"],
                groups.iter().map(|Group { kind: k, tally: t }| {
                    let (trajectories, steps) = (t.trajectories.to_string(), t.steps.to_string());
                    let (env, style, source) = (k.env.clone(), k.style.clone(), k.source.clone());
                    [env, style, source, short(&k.model), trajectories, steps, t.first.clone(), t.last.clone()]
                }),
            )
        };
        let none = format!("none{which} yet; 'learner fit --style aggressive' lets an expert demonstrate");
        section("recordings", groups.len(), &rows, &none);
    }
    if let Some(trajectories) = &listing.trajectories {
        let rows = || {
            table(
                ["trajectory", "environment", "style", "source", "#seed", "#steps", "recorded at"],
                trajectories.iter().map(|t| {
                    let seed = t.seed.map(|seed| seed.to_string()).unwrap_or_default();
                    let (env, style, source) = (t.env.clone(), t.style.clone(), t.source.clone());
                    [t.id.clone(), env, style, source, seed, t.steps.to_string(), t.recorded_at.clone()]
                }),
            )
        };
        section("trajectories", trajectories.len(), &rows, &format!("none{which} yet"));
    }
    if let Some(models) = &listing.models {
        let rows = || {
            table(
                ["model", "environment", "#states", "#actions", "#transitions", "kind", "rewards", "stored at"],
                models.iter().map(|m| {
                    let kind = if m.estimated { "estimated" } else { "exact" };
                    let sizes = (m.n_states.to_string(), m.n_actions.to_string(), m.n_transitions.to_string());
                    let (id, env) = (short(&m.id), m.env.clone());
                    [id, env, sizes.0, sizes.1, sizes.2, kind.into(), m.styles.join(", "), m.stored_at.clone()]
                }),
            )
        };
        section("models", models.len(), &rows, &format!("none{which} yet"));
    }
    if let Some(fits) = &listing.fits {
        let rows = || {
            table(
                ["fit", "environment", "style", "method", "#trajectories", "#agreement", "stopped", "created at"],
                fits.iter().map(|f| {
                    let (trajectories, agreement) = (f.trajectories.to_string(), format!("{:.3}", f.agreement));
                    let stopped = format!("{} after {}", f.stopped, f.iterations);
                    let (env, style, method) = (f.env.clone(), f.style.clone(), f.method.clone());
                    [short(&f.id), env, style, method, trajectories, agreement, stopped, f.created_at.clone()]
                }),
            )
        };
        section("fits", fits.len(), &rows, &format!("none{which} yet"));
    }
    parts.join("\n")
}
