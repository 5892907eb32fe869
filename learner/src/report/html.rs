//! `report.html`: one file that refers to nothing outside, readable on a phone, on paper, in light and in dark.
//!
//! Pictures lie in the page as SVG, frames as data URIs. There is no script. Whatever came from a user is escaped: text by
//! the template, text in pictures by whoever drew them.

use super::format::{METRICS, MISSING, alike, clip, count, duration, interval_parts, options, percent, stopped};
use super::pictures::{self, Picture};
use super::space::{LANES, SPEEDS_MPS, TRAFFIC};
use super::table::{difference_text, highway_choice, summary_rows};
use super::{DriverMetrics, Interval, Report, ReportError};
use base64::Engine as _;
use minijinja::{Environment, Value, context};

/// States in the table of the page at most.
const MOST_STATES: usize = 200;
/// States from which on the table is folded away.
const FOLDED_FROM: usize = 41;

/// The page.
///
/// # Errors
/// Arrays of the wrong shape, or a picture that cannot be drawn.
pub fn render(report: &Report) -> Result<String, ReportError> {
    render_with(report, &pictures::all(report)?)
}

/// The page with pictures that are drawn already.
pub(crate) fn render_with(report: &Report, pictures: &[Picture]) -> Result<String, ReportError> {
    report.check()?;
    let mut environment = Environment::new();
    environment.add_template("report.html", include_str!("report.html.j2"))?;
    let names: Vec<&str> = pictures.iter().map(|picture| picture.name).collect();
    let facts = |rows: Vec<(&'static str, String)>| -> Vec<Value> {
        rows.into_iter().map(|(name, value)| context! { name => name, value => clip(&value, 400) }).collect()
    };
    let mut results = summary_rows(report);
    results.push(("recordings", recordings(report)));
    let page = environment.get_template("report.html")?.render(context! {
        heading => heading(report),
        lead => lead(report),
        driving => driving(report),
        tiles => tiles(report),
        warnings => report.warnings.iter().map(|warning| clip(warning, 2000)).collect::<Vec<_>>(),
        drivers => drivers(report),
        groups => groups(report, pictures),
        frame => frame(report),
        detail => if report.is_highway() { figures(pictures, &["policy_table", "reward_table"]) } else { Vec::new() },
        trace => figures(pictures, &["trace"]),
        states => states(report),
        results => facts(results),
        options => facts(options(report)),
        commands => report.commands.iter().map(|command| clip(command, 2000)).collect::<Vec<_>>(),
        fit_id => clip(&report.fit_id, 100),
        model_id => clip(&report.model_id, 100),
        files => names.join(", "),
    })?;
    Ok(page + "\n")
}

fn heading(report: &Report) -> String {
    let env = clip(&report.env_id, 80);
    if report.style.is_empty() { env } else { format!("{env}: {}", clip(&report.style, 80)) }
}

fn recordings(report: &Report) -> String {
    let from = match report.sources.as_slice() {
        [] => String::new(),
        [source] => format!(", from {}", clip(&source.name, 80)),
        many => {
            let part = |source: &super::Source| {
                format!("{} from {}", count(source.trajectories as f64), clip(&source.name, 80))
            };
            format!(": {}", many.iter().map(part).collect::<Vec<_>>().join(", "))
        }
    };
    format!("{} of at most {} steps{from}", count(report.trajectories as f64), count(f64::from(report.horizon)))
}

/// What was learned from what, with the number that matters most.
fn lead(report: &Report) -> Vec<Value> {
    let plain = |text: String| context! { text => text, strong => false };
    let strong = |text: String| context! { text => text, strong => true };
    let expert = if report.style.is_empty() {
        "an expert".to_owned()
    } else {
        format!("the {} expert", clip(&report.style, 80))
    };
    let mut parts = vec![plain(format!(
        "From {} recorded steps of {expert}, {} ",
        count(report.steps as f64),
        clip(&report.method, 40)
    ))];
    if report.optimal_policy.is_some() {
        parts.push(plain("learned a reward whose greedy policy is optimal in ".into()));
        parts.push(strong(percent(report.agreement)));
        parts.push(plain(" of the states".into()));
        if let Some(difference) = report.expected_value_difference.filter(|x| x.is_finite()) {
            let text = match difference_text(difference).as_str() {
                "0" => "; acting on it loses nothing against the optimal policy".to_owned(),
                lost => format!("; acting on it gives away {lost} of the optimal value"),
            };
            parts.push(plain(text));
        }
        parts.push(plain(".".into()));
        return parts;
    }
    let actor = if report.drivers.is_some() { "driver" } else { "policy" };
    parts.push(plain(format!("learned a {actor} that takes the expert’s action in ")));
    parts.push(strong(percent(report.agreement)));
    parts.push(plain(" of the steps it was shown".into()));
    if let Some(held_out) = report.agreement_held_out.filter(|x| x.is_finite()) {
        parts.push(plain(format!(" and in {} of steps it was not", percent(held_out))));
    }
    parts.push(plain(".".into()));
    parts
}

/// How the learned driver drives, in a sentence.
fn driving(report: &Report) -> Option<String> {
    let drivers = report.drivers.as_ref()?;
    let tell = |metrics: &DriverMetrics| {
        let (speed, _) = interval_parts(&metrics.speed_mps, 1);
        let (collisions, _) = interval_parts(&metrics.collisions, 3);
        format!("{speed} m/s with {collisions} collisions a step")
    };
    let expert = drivers.expert.as_ref().map_or_else(String::new, |expert| format!("; the expert at {}", tell(expert)));
    Some(format!("It drives at {}{expert}; a random driver at {}.", tell(&drivers.learned), tell(&drivers.random)))
}

fn tiles(report: &Report) -> Vec<Value> {
    let tile = |name: &str, value: String, note: String| context! { name => name, value => value, note => note };
    let held_out = report.agreement_held_out.map(|share| format!("{} on unseen steps", percent(share)));
    let covered = f64::from(report.states_covered) / f64::from(report.n_states.max(1));
    let iterations = match report.iterations {
        0 => "no iterations".to_owned(),
        1 => "after 1 iteration".to_owned(),
        n => format!("after {} iterations", count(f64::from(n))),
    };
    let ended = stopped(report.stopped).split(':').next().unwrap_or_default().to_owned();
    let (agreement, of) = match report.optimal_policy {
        Some(_) => ("policy agreement", "of the states act optimally".to_owned()),
        None => ("action agreement", held_out.unwrap_or_else(|| "of the demonstrated steps".into())),
    };
    vec![
        tile(agreement, percent(report.agreement), of),
        tile(
            "states covered",
            format!("{} of {}", count(f64::from(report.states_covered)), count(f64::from(report.n_states))),
            format!("{} by {} steps", percent(covered), count(report.steps as f64)),
        ),
        tile("stopped", ended, iterations),
        tile("time", duration(report.fit_secs), format!("for the fit, {} in all", duration(report.total_secs))),
    ]
}

fn drivers(report: &Report) -> Option<Value> {
    let drivers = report.drivers.as_ref()?;
    let rows =
        [("expert", drivers.expert.as_ref()), ("learned", Some(&drivers.learned)), ("random", Some(&drivers.random))];
    let known: Vec<&DriverMetrics> = rows.iter().filter_map(|row| row.1).collect();
    let scales = METRICS.each_ref().map(|metric| {
        let ends = known.iter().map(|&driver| (metric.of)(driver)).flat_map(|i| [i.low, i.mean, i.high]);
        let ends = ends.filter(|x| x.is_finite());
        let (low, high) = ends.fold((f64::INFINITY, 0.0f64), |(low, high), x| (low.min(x), high.max(x)));
        // Rates are drawn from zero; speeds are not: what matters there is how they differ.
        let low = if metric.rate { low.min(0.0) } else { (low - 0.15 * (high - low)).floor() };
        (metric.decimals(&known), low, if high > low { high } else { low + 1.0 })
    });
    let cell = |value: &Interval, (places, low, high): (usize, f64, f64)| {
        let (mean, spread) = interval_parts(value, places);
        let at = |x: f64| if x.is_finite() { (96.0 * (x - low) / (high - low)).clamp(0.0, 96.0) + 2.0 } else { 2.0 };
        let (left, right) = (at(value.low), at(value.high));
        let text = |x: f64| format!("{x:.2}");
        let bar = value.low.is_finite() && value.high.is_finite();
        context! { mean => mean, spread => spread, dot => value.mean.is_finite(), bar => bar, left => text(left), width => text(right - left), at => text(at(value.mean)) }
    };
    let rows: Vec<Value> = rows
        .iter()
        .map(|&(name, metrics)| {
            let cells: Vec<Value> = METRICS
                .iter()
                .zip(scales)
                .map(|(metric, scale)| metrics.map_or_else(|| context! { mean => "" }, |m| cell((metric.of)(m), scale)))
                .collect();
            context! { name => name, cells => cells }
        })
        .collect();
    let note = report.evaluation.map_or_else(String::new, |evaluation| {
        let (episodes, steps) = (count(evaluation.episodes as f64), count(evaluation.steps as f64));
        format!("{episodes} roll-outs of {steps} steps each.")
    });
    Some(context! { note => note, columns => METRICS.each_ref().map(|metric| metric.name).to_vec(), rows => rows })
}

/// Figures in groups, each with a heading.
fn groups(report: &Report, pictures: &[Picture]) -> Vec<Value> {
    let named = |names: &[&str]| figures(pictures, names);
    let group = |id: &str, title: &str, note: &str, figures: Vec<Value>| {
        (!figures.is_empty()).then(|| context! { id => id, title => title, note => note, figures => figures })
    };
    let mut groups = Vec::new();
    if report.true_reward.is_some() {
        groups.extend(group("weights", "What it values", "", named(&["features"])));
        groups.extend(group("want", "What it wants", "Learned beside true.", named(&["reward", "true_reward"])));
        groups.extend(group("open", "What is open", "What the data leave open.", named(&["uncertainty", "weights"])));
        groups.extend(group("does", "What it does", "Learned beside optimal.", named(&["policy", "optimal_policy"])));
        groups.extend(group("seen", "What was seen, and what it is worth", "", named(&["visits", "values"])));
    } else {
        let pair = if report.is_highway() || report.grid.is_some() {
            ["policy", "reward"]
        } else {
            ["policy_table", "reward_table"]
        };
        groups.extend(group("weights", "What it wants", "", named(&["features"])));
        groups.extend(group("learned", "What was learned", "", named(&pair)));
        groups.extend(group("open", "What is open", "What the data leave open.", named(&["uncertainty", "weights"])));
        groups.extend(group("seen", "What was seen, and what it is worth", "", named(&["visits", "values"])));
    }
    groups.extend(group("judged", "How well it predicts", "Cross-validation.", named(&["calibration"])));
    groups
}

/// Pictures by name, as figures.
fn figures(pictures: &[Picture], names: &[&str]) -> Vec<Value> {
    let figure = |picture: &Picture| {
        context! { picture => Value::from_safe_string(inline(&picture.svg)), caption => picture.caption.clone() }
    };
    names.iter().filter_map(|name| pictures.iter().find(|picture| picture.name == *name)).map(figure).collect()
}

/// The frame, as a figure.
fn frame(report: &Report) -> Option<Value> {
    let frame = report.frame_png.as_ref()?;
    let alt = format!("A frame of {}, driven by the learned policy", heading(report));
    let caption = "A frame of the environment as the learned policy acts in it; what it controls is highlighted.";
    Some(context! { picture => image(frame, &alt), caption => caption })
}

/// An image element with its attributes escaped.
fn image(png: &[u8], alt: &str) -> Value {
    let source = format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png));
    // Width and height stand at a fixed place of every PNG. A frame as wide as a road takes the width of the page.
    let side = |at: usize| png.get(at..at + 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
    let wide = side(16).zip(side(20)).is_some_and(|(width, height)| u64::from(width) > 2 * u64::from(height));
    let class = if wide { "wide" } else { "square" };
    let alt = alt.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;").replace('>', "&gt;");
    Value::from_safe_string(format!("<img class=\"{class}\" src=\"{source}\" alt=\"{alt}\">"))
}

/// A picture for the inside of a page: without the namespace, which HTML knows, and without the title that would pop up.
fn inline(svg: &str) -> String {
    let svg = svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1);
    match (svg.find("<title>"), svg.find("</title>\n")) {
        (Some(from), Some(to)) if from < to => format!("{}{}", &svg[..from], &svg[to + "</title>\n".len()..]),
        _ => svg,
    }
}

fn states(report: &Report) -> Value {
    let (states, all) = report.leading_states(MOST_STATES);
    let reward = alike(states.iter().map(|&state| report.greedy_reward(state)));
    let value = alike(states.iter().map(|&state| report.state_values[state]));
    let numbers = |state: usize| {
        [reward(report.greedy_reward(state)), value(report.state_values[state]), count(report.state_visits[state])]
    };
    let column = |name: &str, text: bool| context! { name => name, text => text };
    let mut rows: Vec<Value> = Vec::new();
    let mut row = |state: usize, group: bool, cells: Vec<String>| {
        let class = [(group, "group"), (!report.visited(state), "unseen")];
        let class: Vec<&str> = class.iter().filter(|on| on.0).map(|on| on.1).collect();
        rows.push(context! { class => class.join(" "), cells => cells });
    };
    let mut columns;
    if report.is_highway() {
        columns = vec![column("lane", true), column("m/s", false), column("traffic", true)];
        for i in 0..36 {
            let (lane, speed, traffic) = (2 - i / 12, i / 3 % 4, i % 3);
            let state = super::space::highway_state(lane, speed, traffic);
            let names = [LANES[lane].to_owned(), SPEEDS_MPS[speed].to_string(), TRAFFIC[traffic].to_owned()];
            let cells = names.into_iter().chain([highway_choice(report, state)]).chain(numbers(state)).collect();
            row(state, i % 12 == 0 && i > 0, cells);
        }
    } else {
        columns = vec![column("state", true)];
        for &state in &states {
            let choices = report.choices(&report.greedy_policy, state);
            let action = match choices.as_slice() {
                [] => MISSING.to_owned(),
                all if all.len() == report.actions() && all.len() > 1 => "any".to_owned(),
                some => some.iter().take(3).map(|&(a, _)| report.action_name(a, 40)).collect::<Vec<_>>().join(", "),
            };
            row(state, false, [report.state_name(state, 60), action].into_iter().chain(numbers(state)).collect());
        }
    }
    columns.extend([
        column("greedy action", true),
        column("reward", false),
        column("value", false),
        column("visits", false),
    ]);
    let which = if all {
        String::new()
    } else {
        format!("The {} states visited most of {}. ", states.len(), count(f64::from(report.n_states)))
    };
    let note = format!(
        "{which}The greedy action of the learned policy, its reward, the state’s value and its visits by the \
         demonstrations. States in italics were not visited."
    );
    context! { note => note, columns => columns, count => states.len(), folded => states.len() >= FOLDED_FROM,
    fixed => report.is_highway(), rows => rows }
}
