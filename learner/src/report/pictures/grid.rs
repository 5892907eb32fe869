//! Environments on a grid: visits, rewards, values and policies over the cells; Hahn & Zoubir (2015), Fig. 1.

use super::canvas::{Canvas, Type, text_width};
use super::colour::{DIFFERS, INK, MUTED, RULE, Scale, WALL};
use super::panel::{BAR, MARGIN, TITLE, WIDTH, bar, not_visited, title};
use super::{Part, Picture};
use crate::report::format::{alike, count, unit};
use crate::report::space::Heading;
use crate::report::{GridLayout, Report, ReportError};
use plotters::style::{Color, RGBAColor};

/// What a panel shows.
enum Content {
    /// A number in each state; whether unvisited states are hatched; what the colour bar is called.
    Heat { values: Vec<f64>, scale: Scale, bar: &'static str, hatch: bool },
    /// What a policy does in each state; states that differ from another policy are tinted.
    Policy { policy: Vec<f64>, reference: Option<Vec<f64>>, hatch: bool },
}

/// One grid with its title and key.
struct Panel {
    name: &'static str,
    part: Part,
    title: &'static str,
    note: String,
    caption: String,
    content: Content,
}

/// Where the cells lie on a panel.
struct Geometry {
    cell: f64,
    left: f64,
    width: f64,
    height: f64,
}

impl Geometry {
    fn new(grid: &GridLayout) -> Self {
        let room = WIDTH - 2.0 * MARGIN;
        let (rows, columns) = (f64::from(grid.rows.max(1)), f64::from(grid.columns.max(1)));
        let cell = (room / columns).min(560.0 / rows).min(72.0);
        let width = cell * columns;
        Self { cell, left: MARGIN + (room - width) / 2.0, width, height: cell * rows }
    }

    fn panel_height(&self) -> f64 {
        TITLE + self.height + BAR
    }
}

/// All pictures of an environment on a grid; none where it has no grid.
pub(super) fn pictures(report: &Report) -> Result<Vec<Picture>, ReportError> {
    let Some(grid) = &report.grid else { return Ok(Vec::new()) };
    let geometry = Geometry::new(grid);
    let panels = panels(report);
    let size = (WIDTH, geometry.panel_height());
    let mut pictures = vec![figure1(report, &geometry, &panels)?];
    for panel in &panels {
        let svg = Canvas::draw(panel.name, size, &format!("{}: {}", panel.title, panel.note), |canvas| {
            paint(canvas, report, &geometry, panel, (0.0, 0.0));
        })?;
        pictures.push(Picture {
            name: panel.name,
            part: panel.part,
            title: panel.title,
            caption: panel.caption.clone(),
            svg,
        });
    }
    Ok(pictures)
}

/// The panels: what was seen, what was learned, what is true.
fn panels(report: &Report) -> Vec<Panel> {
    let visits = report.state_visits.clone();
    let learned: Vec<f64> = (0..report.states()).map(|state| report.greedy_reward(state)).collect();
    let mut panels = vec![Panel {
        name: "visits",
        part: Part::Seen,
        title: "Visits",
        note: format!("steps of the demonstrations in each state, {} in all", count(visits.iter().sum())),
        caption: "How often the demonstrations visit each state: all that the learner knows of the expert.".into(),
        content: Content::Heat {
            scale: Scale::from_zero(visits.iter().copied()),
            values: visits,
            bar: "visits",
            hatch: true,
        },
    }];
    panels.push(Panel {
        name: "reward",
        part: Part::Learned,
        title: "Estimated reward",
        note: "what the learner takes the expert to want".into(),
        caption:
            "The reward that explains the demonstrations. A reward is known up to its scale only: compare where it \
                  lies, not how much it is."
                .into(),
        content: Content::Heat {
            scale: Scale::from_zero(learned.iter().copied()),
            values: learned,
            bar: "estimated reward",
            hatch: true,
        },
    });
    if let Some(uncertainty) = report.uncertainty.as_ref().filter(|_| report.weights.len() == report.states()) {
        let widths: Vec<f64> = (0..report.states()).map(|state| uncertainty.width(state)).collect();
        panels.push(Panel {
            name: "uncertainty",
            part: Part::Learned,
            title: "What is open",
            note: "width of the 95 % interval of each state's reward".into(),
            caption: "How far apart the ends of each reward's 95 % interval lie: darker is less certain, a question mark is a \
                      reward that the demonstrations do not determine at all."
                .into(),
            content: Content::Heat {
                scale: Scale::from_zero(widths.iter().copied()),
                values: widths,
                bar: "width of the interval",
                hatch: true,
            },
        });
    }
    if let Some(truth) = report.true_state_reward() {
        panels.push(Panel {
            name: "true_reward",
            part: Part::True,
            title: "True reward",
            note: "what the expert was after, unknown to the learner".into(),
            caption: "The reward under which the expert is optimal; the learner never sees it.".into(),
            content: Content::Heat {
                scale: Scale::from_zero(truth.iter().copied()),
                values: truth,
                bar: "true reward",
                hatch: false,
            },
        });
    }
    let mut sight = "An arrow points where the greedy policy goes; several arrows are ties.".to_owned();
    if report.optimal_policy.is_some() {
        sight += " Tinted states take an action that is not optimal.";
    }
    if report.headings().is_some() {
        panels.push(Panel {
            name: "policy",
            part: Part::Learned,
            title: "Learned policy",
            note: "greedy action under the estimated reward".into(),
            caption: sight,
            content: Content::Policy {
                policy: report.greedy_policy.clone(),
                reference: report.optimal_policy.clone(),
                hatch: true,
            },
        });
        if let Some(optimal) = &report.optimal_policy {
            panels.push(Panel {
                name: "optimal_policy",
                part: Part::True,
                title: "Optimal policy",
                note: "under the true reward, ties split evenly".into(),
                caption: "What the expert does: the optimal actions under the true reward.".into(),
                content: Content::Policy { policy: optimal.clone(), reference: None, hatch: false },
            });
        }
    }
    panels.push(Panel {
        name: "values",
        part: Part::Learned,
        title: "State values",
        note: "expected discounted sum of the estimated reward".into(),
        caption: "How good it is to be in each state under the estimated reward.".into(),
        content: Content::Heat {
            scale: Scale::over(report.state_values.iter().copied()),
            values: report.state_values.clone(),
            bar: "value",
            hatch: false,
        },
    });
    panels
}

/// All panels on one sheet: the learned above, the true below.
fn figure1(report: &Report, geometry: &Geometry, panels: &[Panel]) -> Result<Picture, ReportError> {
    let named = |names: [&str; 3]| -> Vec<&Panel> {
        names.iter().filter_map(|name| panels.iter().find(|panel| panel.name == *name)).collect()
    };
    let rows: Vec<Vec<&Panel>> = if report.true_reward.is_some() {
        vec![named(["visits", "reward", "policy"]), named(["values", "true_reward", "optimal_policy"])]
    } else {
        vec![named(["visits", "reward", "policy"])]
    };
    let size = (3.0 * WIDTH, geometry.panel_height() * rows.len() as f64);
    let label = "Visits, estimated reward and learned policy over the grid, beside the true ones";
    let svg = Canvas::draw("figure1", size, label, |canvas| {
        for (i, row) in rows.iter().enumerate() {
            for (j, panel) in row.iter().enumerate() {
                paint(canvas, report, geometry, panel, (j as f64 * WIDTH, i as f64 * geometry.panel_height()));
            }
        }
    })?;
    let caption = "Hahn & Zoubir (2015), Fig. 1: visits, reward and policy in one picture.".to_owned();
    Ok(Picture { name: "figure1", part: Part::Sheet, title: "Seen, learned and true", caption, svg })
}

fn paint(canvas: &Canvas<'_>, report: &Report, geometry: &Geometry, panel: &Panel, (x, y): (f64, f64)) {
    let Some(grid) = &report.grid else { return };
    title(canvas, x + MARGIN, y, WIDTH - 2.0 * MARGIN, panel.title, &panel.note);
    let (left, top, cell) = (x + geometry.left, y + TITLE, geometry.cell);
    canvas.rect(left, top, geometry.width, geometry.height, WALL);
    let place =
        |index: u32| (left + f64::from(index % grid.columns) * cell, top + f64::from(index / grid.columns) * cell);
    let foot = top + geometry.height;
    let room = WIDTH - 2.0 * MARGIN;
    match &panel.content {
        Content::Heat { values, scale, bar: name, hatch } => {
            let (factor, unit) = unit(values);
            let write = alike(values.iter().map(|value| value / factor));
            let whole = *name == "visits";
            for (state, &index) in grid.cells.iter().enumerate() {
                let (x, y) = place(index);
                let value = values[state];
                canvas.rect(x, y, cell, cell, scale.colour(value));
                let hatched = *hatch && !report.visited(state);
                if hatched {
                    canvas.hatch(x, y, cell, cell);
                }
                let text = if whole { count(value) } else { write(value / factor) };
                if value.is_infinite() {
                    canvas.text(x + cell / 2.0, y + cell / 2.0, "?", Type::new(13.0).centred().bold().colour(MUTED));
                }
                // Zeros are left to the eye: a field of them hides the rest.
                if value.is_finite() && value != 0.0 && text_width(&text, 11.0) < cell - 2.0 {
                    if hatched {
                        canvas.rect(x + 2.0, y + cell / 2.0 - 7.5, cell - 4.0, 15.0, scale.colour(value));
                    }
                    canvas.text(
                        x + cell / 2.0,
                        y + cell / 2.0,
                        &text,
                        Type::new(11.0).centred().colour(scale.ink(value)),
                    );
                }
                canvas.outline(x, y, cell, cell, RULE, 0.7);
            }
            let unvisited = *hatch && (0..report.states()).any(|state| !report.visited(state));
            let (scale, name) = (
                scale.divided(if whole { 1.0 } else { factor }),
                if whole { (*name).to_owned() } else { format!("{name}{unit}") },
            );
            bar(canvas, x + MARGIN, foot, room, &scale, &name, unvisited);
        }
        Content::Policy { policy, reference, hatch } => {
            let headings = report.headings().unwrap_or_default();
            let mut differs = false;
            for (state, &index) in grid.cells.iter().enumerate() {
                let (x, y) = place(index);
                let choices = report.choices(policy, state);
                let wrong = reference.as_ref().is_some_and(|reference| {
                    choices.iter().any(|&(action, _)| reference[state * report.actions() + action] <= 0.0)
                });
                differs |= wrong;
                canvas.rect(x, y, cell, cell, if wrong { DIFFERS } else { super::colour::PAPER });
                let seen = !hatch || report.visited(state);
                if !seen {
                    canvas.hatch(x, y, cell, cell);
                }
                let directions: Vec<Heading> = choices.iter().map(|&(action, _)| headings[action]).collect();
                arrows(
                    canvas,
                    (x + cell / 2.0, y + cell / 2.0),
                    cell,
                    &directions,
                    INK.mix(if seen { 1.0 } else { 0.5 }),
                );
                canvas.outline(x, y, cell, cell, RULE, 0.7);
            }
            let mut key = x + MARGIN;
            if *hatch && (0..report.states()).any(|state| !report.visited(state)) {
                not_visited(canvas, key, foot + 14.0);
                key += 110.0;
            }
            if differs {
                canvas.rect(key, foot + 7.5, 18.0, 13.0, DIFFERS);
                canvas.outline(key, foot + 7.5, 18.0, 13.0, RULE, 0.8);
                canvas.text(
                    key + 24.0,
                    foot + 14.0,
                    "not an optimal action",
                    Type::new(10.5).colour(super::colour::MUTED),
                );
            }
        }
    }
}

/// One arrow through the middle of a cell, or one from the middle for each tie.
fn arrows(canvas: &Canvas<'_>, (x, y): (f64, f64), cell: f64, directions: &[Heading], ink: RGBAColor) {
    for &heading in directions {
        let (dx, dy) = heading.vector();
        if heading == Heading::Stay {
            canvas.disc(x, y, 0.11 * cell, ink);
        } else if directions.len() == 1 {
            canvas.arrow((x, y), (dx, dy), 0.6 * cell, ink);
        } else {
            let length = 0.4 * cell;
            canvas.arrow((x + dx * length / 2.0, y + dy * length / 2.0), (dx, dy), length, ink);
        }
    }
}
