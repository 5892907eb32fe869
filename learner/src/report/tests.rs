//! What a person sees, checked: contents, order, escapes, and that nothing in it is a guess of a drawing library.

use super::table::Terminal;
use super::{Report, ReportError, html, json, pictures, samples, table, write};
use crate::irl::Stopped;
use serde_json::Value;
use std::path::Path;

fn text(report: &Report, width: usize) -> String {
    table::render(report, Terminal { width, colour: false }).expect("a whole report")
}

/// Reports that are allowed and odd.
fn odd() -> Vec<(&'static str, Report)> {
    let mut empty = samples::plain(1, 1);
    empty.state_visits = vec![0.0];
    empty.trace.clear();
    empty.iterations = 0;
    empty.stopped = Stopped::ClosedForm;
    empty.trajectories = 0;
    empty.steps = 0;
    empty.sources.clear();
    empty.style.clear();
    empty.commands.clear();

    let mut missing = samples::highway();
    let drivers = missing.drivers.as_mut().expect("drivers");
    drivers.expert = None;
    drivers.learned.collisions.mean = f64::NAN;
    drivers.random.speed_mps.high = f64::INFINITY;
    missing.reward.fill(f64::NAN);
    missing.state_values[3] = f64::INFINITY;
    missing.state_values[4] = f64::NEG_INFINITY;
    missing.state_visits.fill(0.0);
    missing.greedy_policy.fill(0.0);
    missing.agreement = f64::NAN;
    missing.log_likelihood_per_step = f64::NEG_INFINITY;
    missing.fit_secs = f64::NAN;
    missing.trace[0].objective = f64::NAN;
    missing.trace[1].change = f64::INFINITY;
    missing.trace[2].change = 0.0;

    let mut maze = samples::maze();
    maze.reward.fill(f64::NAN);
    maze.state_visits.fill(0.0);
    maze.expected_value_difference = Some(f64::NAN);
    maze.trace.truncate(1);

    let mut negative = samples::maze();
    negative.reward.iter_mut().enumerate().for_each(|(i, r)| *r = (i as f64 / 4.0).floor() * 1e-7 - 2e-6);
    negative.optimal_policy = None;
    negative.true_reward = None;

    let mut hostile = samples::plain(5, 3);
    let bad = "<script>alert('\"&')</script>\u{1b}[31m\n{{ 7 * 7 }}";
    for text in
        [&mut hostile.env_id, &mut hostile.style, &mut hostile.method, &mut hostile.fit_id, &mut hostile.model_id]
    {
        bad.clone_into(text);
    }
    hostile.state_labels = vec![bad.into(); 5];
    hostile.action_labels = vec![bad.into(); 3];
    hostile.sources[0].name = bad.into();
    hostile.warnings = vec![bad.into()];
    hostile.commands = vec![bad.into()];

    let mut flat = samples::plain(4, 2);
    flat.trace.iter_mut().for_each(|entry| (entry.objective, entry.change) = (-3.0, 0.0));
    flat.reward.fill(0.0);
    flat.state_values.fill(0.0);

    vec![
        ("empty", empty),
        ("missing", missing),
        ("maze", maze),
        ("negative", negative),
        ("hostile", hostile),
        ("flat", flat),
        ("many states", samples::plain(1000, 3)),
        ("many actions", samples::plain(8, 300)),
    ]
}

fn all() -> Vec<(&'static str, Report)> {
    let mut reports =
        vec![("highway", samples::highway()), ("grid", samples::maze()), ("plain", samples::plain(30, 3))];
    reports.extend(odd());
    reports
}

#[test]
fn json_has_the_agreed_keys_in_order() {
    let line = json::to_string(&samples::highway(), Some(Path::new("out/report.html")));
    insta::assert_snapshot!(line, @r#"{"env":"Highway-v0","style":"aggressive","method":"em-tied","trajectories":200,"horizon":5,"drivers":{"expert":{"speed_mps":{"mean":33.92,"low":33.81,"high":34.03},"collisions":{"mean":0.0068,"low":0.0053,"high":0.0083},"overtakes_left":{"mean":0.149,"low":0.143,"high":0.155},"overtakes_right":{"mean":0.112,"low":0.1055,"high":0.1185}},"learned":{"speed_mps":{"mean":33.41,"low":33.3,"high":33.52},"collisions":{"mean":0.031,"low":0.0271,"high":0.0349},"overtakes_left":{"mean":0.131,"low":0.125,"high":0.137},"overtakes_right":{"mean":0.104,"low":0.0979,"high":0.1101}},"random":{"speed_mps":{"mean":26.74,"low":26.63,"high":26.85},"collisions":{"mean":0.061,"low":0.0541,"high":0.0679},"overtakes_left":{"mean":0.058,"low":0.052,"high":0.064},"overtakes_right":{"mean":0.047,"low":0.0438,"high":0.0503}}},"agreement":0.991,"states_covered":32,"stopped":"converged","iterations":46,"fit_secs":0.18,"total_secs":6.42,"report":"out/report.html"}"#);
    let line = json::to_string(&samples::maze(), None);
    insta::assert_snapshot!(line, @r#"{"env":"Maze-v0","style":"optimal","method":"em","trajectories":20,"horizon":50,"expected_value_difference":0.3127,"agreement":0.7719298245614035,"states_covered":42,"stopped":"converged","iterations":14,"fit_secs":0.031,"total_secs":0.4,"report":null}"#);
}

#[test]
fn json_knows_no_number_that_is_none() {
    for (name, report) in odd() {
        let line = json::to_string(&report, None);
        let value: Value = serde_json::from_str(&line).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(!line.contains("NaN") && !line.contains("inf"), "{name}: {line}");
        assert_eq!(value.get("drivers").is_some(), report.is_highway(), "{name}");
        assert_eq!(value.get("expected_value_difference").is_some(), !report.is_highway(), "{name}");
    }
}

#[test]
fn the_terminal_shows_the_highway() {
    let shown = text(&samples::highway(), 132);
    for part in [
        "expert    ",
        "33.92 ± 0.11",
        "0.031 ± 0.004",
        "0.061 ± 0.007",
        "99.1 % of the demonstrated steps; 97.8 %",
        "32 of 36",
        "converged after 46 iterations",
        "passable:",
        "boxed in:",
        "right 35",
        "any",
        "warning: ",
    ] {
        assert!(shown.contains(part), "{part:?} in\n{shown}");
    }
    // One line for every lane and speed where there is room, one for every state where there is not.
    for width in [108, 120, 132] {
        let shown = text(&samples::highway(), width);
        let states = shown
            .lines()
            .filter(|line| line.contains("keep 35") && line.contains("right 35") | line.contains("left 35"));
        assert_eq!(states.count(), 12, "at {width}:\n{shown}");
    }
    let narrow = text(&samples::highway(), 80);
    assert_eq!(narrow.lines().filter(|line| line.contains("boxed in")).count(), 12);
}

#[test]
fn the_terminal_shows_the_maze_beside_its_optimum() {
    let shown = text(&samples::maze(), 80);
    let rows: Vec<&str> =
        shown.lines().skip_while(|line| !line.contains("optimal") || !line.contains("learned")).skip(1).collect();
    assert_eq!(rows.len(), 9);
    assert_eq!(rows[0], "  ↖ ← ← ← → → → → ↗    ↖ ← ← ← → → → → ↗");
    assert_eq!(rows[1].matches('█').count(), 12);
    assert!(shown.contains("77.2 % of the states"), "{shown}");
    assert!(shown.contains("expected value difference 0.313"), "{shown}");
}

#[test]
fn no_line_is_wider_than_the_terminal() {
    for (name, report) in all() {
        for width in [80, 100, 107, 108, 160] {
            for line in text(&report, width).lines().filter(|line| !line.starts_with("warning")) {
                assert!(line.chars().count() <= width, "{name} at {width}: {line:?}");
            }
        }
    }
}

#[test]
fn colours_are_written_only_where_they_are_wanted() {
    let coloured = table::render(&samples::highway(), Terminal { width: 132, colour: true }).expect("a whole report");
    assert!(coloured.contains("\u{1b}["));
    for (name, report) in all() {
        assert!(!text(&report, 100).contains('\u{1b}'), "{name}");
    }
}

#[test]
fn nothing_shown_is_no_number() {
    for (name, report) in all() {
        let page = html::render(&report).unwrap_or_else(|error| panic!("{name}: {error}"));
        for shown in [text(&report, 120), page] {
            for bad in ["NaN", "inf ", "inf<", "-0.00", ">inf"] {
                assert!(!shown.contains(bad), "{name}: {bad}");
            }
        }
    }
}

#[test]
fn the_page_refers_to_nothing_outside() {
    for (name, report) in all() {
        let page = html::render(&report).unwrap_or_else(|error| panic!("{name}: {error}"));
        for bad in ["http:", "https:", "url(", "@import", "<script", "<link", "<iframe", "src=\"/", "href="] {
            assert!(!page.contains(bad), "{name}: {bad}");
        }
        let sources = page.matches("src=\"").count();
        assert_eq!(sources, page.matches("src=\"data:image/png;base64,").count(), "{name}");
    }
}

#[test]
fn the_page_escapes_what_a_user_wrote() {
    let (_, report) = odd().into_iter().find(|(name, _)| *name == "hostile").expect("it is there");
    let page = html::render(&report).expect("a page");
    assert!(page.contains("&lt;script&gt;"));
    assert!(page.contains("{{ 7 * 7 }}"));
    assert!(!page.contains('\u{1b}'));
    for picture in pictures::all(&report).expect("pictures") {
        assert!(!picture.svg.contains("<script"), "{}", picture.name);
        assert!(pictures::png(&picture.svg).is_ok(), "{}", picture.name);
    }
}

#[test]
fn the_page_has_every_picture_with_a_name_for_those_who_cannot_see_it() {
    for (name, report) in all() {
        let page = html::render(&report).expect("a page");
        let drawn = pictures::all(&report).expect("pictures");
        let shown = drawn.iter().filter(|picture| picture.part != pictures::Part::Sheet).count();
        assert_eq!(page.matches("<svg ").count(), shown, "{name}");
        assert_eq!(page.matches("role=\"img\" aria-label=\"").count(), shown, "{name}");
        for picture in &drawn {
            assert!(!picture.caption.is_empty() && !picture.title.is_empty(), "{name}: {}", picture.name);
        }
    }
}

#[test]
fn pictures_are_those_of_the_process() {
    let names = |report: &Report| -> Vec<&str> {
        pictures::all(report).expect("pictures").iter().map(|picture| picture.name).collect()
    };
    let grid = ["figure1", "visits", "reward", "true_reward", "policy", "optimal_policy", "values", "trace"];
    assert_eq!(names(&samples::maze()), grid);
    let highway = ["policy", "reward", "visits", "values", "policy_table", "reward_table", "trace"];
    assert_eq!(names(&samples::highway()), highway);
    assert_eq!(names(&samples::plain(6, 2)), ["policy_table", "reward_table", "visits", "values", "trace"]);
    assert_eq!(names(&odd()[0].1), ["policy_table", "reward_table", "visits", "values"]);
}

/// Share of the pixels that are not paper.
fn inked(png: &[u8]) -> f64 {
    let pixels = resvg::tiny_skia::Pixmap::decode_png(png).expect("a PNG");
    let data = pixels.pixels();
    data.iter().filter(|pixel| pixel.red() < 250 || pixel.green() < 250 || pixel.blue() < 250).count() as f64
        / data.len() as f64
}

#[test]
fn text_is_drawn_with_the_font_that_we_bring() {
    let document = |content: &str| {
        let family = "Inter, 'Segoe UI', Roboto, Ubuntu, sans-serif";
        format!(
            "<svg width=\"200\" height=\"40\" xmlns=\"http://www.w3.org/2000/svg\">\n<text x=\"4\" y=\"30\" \
             font-family=\"{family}\" font-size=\"24\" fill=\"#000000\">{content}</text>\n</svg>"
        )
    };
    let blank = inked(&pictures::png(&document("")).expect("a picture"));
    let word = inked(&pictures::png(&document("reward ± 0.1")).expect("a picture"));
    assert!(blank == 0.0 && word > 0.05, "{blank} {word}");
}

#[test]
fn a_report_is_written_whole() {
    let directory = tempfile::tempdir().expect("a directory");
    for (name, report) in [("highway", samples::highway()), ("grid", samples::maze())] {
        let place = directory.path().join(name).join("deeper");
        let written = write::write(&report, &place).expect("written");
        // Again, over what is there.
        assert_eq!(write::write(&report, &place).expect("written again"), written);
        assert_eq!(written.html, place.join("report.html"));
        let page = std::fs::read_to_string(&written.html).expect("a page");
        assert!(page.starts_with("<!doctype html>") && page.ends_with("</html>\n"), "{name}");
        let mut names: Vec<_> =
            std::fs::read_dir(&place).expect("a directory").map(|f| f.expect("a file").path()).collect();
        names.sort();
        let mut expected = written.pictures.clone();
        expected.push(written.html.clone());
        expected.sort();
        assert_eq!(names, expected, "{name}: nothing else is left behind");
        for path in written.pictures.iter().filter(|path| path.extension().is_some_and(|e| e == "png")) {
            let share = inked(&std::fs::read(path).expect("a file"));
            assert!(share > 0.01, "{}: {share}", path.display());
        }
    }
}

#[test]
fn the_same_report_gives_the_same_files() {
    for report in [samples::highway(), samples::maze()] {
        assert_eq!(html::render(&report).expect("a page"), html::render(&report).expect("a page"));
        assert_eq!(pictures::all(&report).expect("pictures"), pictures::all(&report).expect("pictures"));
    }
}

#[test]
fn a_wrong_shape_is_an_error_that_names_the_field() {
    let mut report = samples::maze();
    report.state_values.pop();
    let shown = table::render(&report, Terminal { width: 80, colour: false });
    assert!(matches!(shown, Err(ReportError::Shape { field: "state_values", expected: 57, got: 56 })), "{shown:?}");
    assert!(html::render(&report).is_err() && pictures::all(&report).is_err());
    let mut report = samples::maze();
    report.grid.as_mut().expect("a grid").cells[5] = 81;
    let error = report.check().expect_err("a cell outside");
    assert_eq!(error.to_string(), "expected grid cells below 81, got 81");
}

#[test]
#[ignore = "writes the samples to target/sample-reports, to be looked at"]
fn sample_reports() {
    let place = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/sample-reports");
    for (name, report) in all() {
        write::write(&report, &place.join(name.replace(' ', "_"))).expect("written");
    }
}
