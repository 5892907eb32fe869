//! What can be done with an imported environment beside a plain fit: methods compared on users' recordings and features, the
//! learned reward planned on in another imported model, a finite horizon without discount, and the data of a fit exported.

use mazeway_tests::desk::{failed, object, said};
use serde_json::{Value, json};
use std::{fs, path::Path};
use tempfile::TempDir;

/// The example of the documentation: its model and its three walks.
fn commute() -> (TempDir, Value) {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples/commute");
    let data = tempfile::tempdir().expect("a directory");
    for name in ["commute.json", "walks.csv"] {
        fs::copy(examples.join(name), data.path().join(name)).expect("a copy");
    }
    said(&data, &["import", "--model", "commute.json", "walks.csv"]);
    let model = fs::read_to_string(data.path().join("commute.json")).expect("a model");
    (data, serde_json::from_str(&model).expect("JSON"))
}

const COMPARE: [&str; 10] =
    ["compare", "--env", "Commute", "--trajectories", "1,2", "--seeds", "2", "--out", "out", "--features"];

#[test]
fn methods_are_compared_on_recordings_and_features_of_ones_own() {
    let (data, _) = commute();
    let asked = [&COMPARE[..], &["green,noise", "--methods", "em-tied:posterior=none,bc"]].concat();
    let rows = object(&data, &asked);
    let rows = rows.as_array().expect("an array");
    let named = rows.iter().map(|row| (row["method"].as_str(), row["trajectories"].as_u64())).collect::<Vec<_>>();
    let tied = Some("em-tied:posterior=none");
    assert_eq!(named, [(tied, Some(1)), (tied, Some(2)), (Some("bc"), Some(1)), (Some("bc"), Some(2))]);
    for row in rows {
        assert_eq!(row["seeds"], 2, "every fit is one: {row}");
        // The stroller's reward is known, and so is what is lost.
        for measure in ["agreement", "evd"] {
            assert!(row[measure]["mean"].as_f64().is_some_and(|mean| mean >= 0.0), "{row}");
        }
    }
    // Once more: all is found, nothing is fitted, and the numbers are the same.
    assert!(said(&data, &asked).contains("4 of 4 fits") || said(&data, &asked).contains("8 of 8 fits"));
    assert_eq!(object(&data, &asked).as_array().expect("an array"), rows);

    let more = ["compare", "--env", "Commute", "--methods", "bc", "--out", "out", "--trajectories"];
    let error = failed(&data, &[&more[..], &["3"]].concat(), 1);
    assert!(error.contains("more than 3 recordings of style 'stroller'") && error.ends_with("got 3"), "{error}");
    let error = failed(&data, &[&more[..], &["1", "--env-option", "slip=0.1"]].concat(), 2);
    assert!(error.contains("no server simulates Commute"), "{error}");
    let error = failed(&data, &["compare", "--env", "Nowhere", "--out", "out"], 2);
    assert!(error.contains("unknown environment 'Nowhere'"), "{error}");
}

#[test]
fn a_learned_reward_is_planned_on_in_another_imported_model() {
    let (data, mut model) = commute();
    // The park is closed on most days: the bus is what is left, and the stroller's reward says so.
    model["transitions"][4] = json!(["street", "walk", "park", 0.1]);
    model["transitions"][5] = json!(["street", "walk", "street", 0.9]);
    fs::write(data.path().join("closed.json"), model.to_string()).expect("a file");
    let closed = object(&data, &["import", "--model", "closed.json", "--env", "Closed"]);
    let id = closed["model"]["id"].as_str().expect("an id");
    let fit = ["fit", "--env", "Commute", "--style", "stroller", "--out", "out", "--plan-in"];
    let report = object(&data, &[&fit[..], &[&id[..12]]].concat());
    let transfer = &report["transfer"];
    assert!(transfer["target"].as_str().is_some_and(|told| told.contains("Closed")), "{transfer}");
    assert_eq!(transfer["new_states"], 0);
    let rows = transfer["rows"].as_array().expect("rows");
    let names = rows.iter().map(|row| row["name"].as_str().expect("a name")).collect::<Vec<_>>();
    assert_eq!(names.len(), 4, "{names:?}");
    assert!(names[0].contains("planned on anew") && names[3] == "the optimal policy there", "{names:?}");
    let lost = |row: &Value| row["expected_value_difference"].as_f64().expect("a number");
    assert!(rows.iter().all(|row| lost(row) >= -1e-12) && lost(&rows[3]).abs() < 1e-9, "{rows:?}");
    let error = failed(&data, &[&fit[..], &["0123456789ab"]].concat(), 1);
    assert!(error.contains("0123456789ab"), "{error}");
    // One with other actions cannot be planned in.
    model["actions"] = json!(["walk", "tram"]);
    for transition in model["transitions"].as_array_mut().expect("rows") {
        if transition[1] == "bus" {
            transition[1] = json!("tram");
        }
    }
    model["transitions"].as_array_mut().expect("rows").retain(|transition| transition[1] != "tram");
    model["actions"] = json!(["walk"]);
    fs::write(data.path().join("other.json"), model.to_string()).expect("a file");
    let other = object(&data, &["import", "--model", "other.json", "--env", "Other"]);
    let id = other["model"]["id"].as_str().expect("an id");
    failed(&data, &[&fit[..], &[id]].concat(), 1);
}

#[test]
fn without_discount_a_horizon_is_planned_for() {
    let (data, _) = commute();
    let fit = ["fit", "--env", "Commute", "--style", "stroller", "--out", "out", "--discount", "1"];
    let report = object(&data, &[&fit[..], &["--horizon", "4"]].concat());
    assert_eq!((&report["trajectories"], &report["horizon"]), (&json!(3), &json!(4)));
    let (agreement, lost) = (&report["agreement"], &report["expected_value_difference"]);
    assert!(agreement.as_f64().is_some_and(|share| (0.0..=1.0).contains(&share)), "{report}");
    assert!(lost.as_f64().is_some_and(|lost| lost >= -1e-12), "what is lost in four steps: {report}");
    // Five steps were not recorded, and without a horizon nothing is bounded.
    let error = failed(&data, &[&fit[..], &["--horizon", "5"]].concat(), 1);
    assert!(error.contains("nothing is recorded for Commute") || error.contains("recordings"), "{error}");
    failed(&data, &[&fit[..], &["--method", "mce"]].concat(), 2);
}

#[test]
fn what_a_fit_used_is_exported() {
    let (data, _) = commute();
    said(&data, &["fit", "--env", "Commute", "--trajectories", "2", "--out", "out", "--json"]);
    let listed = object(&data, &["list"]);
    let listed = listed["fits"].as_array().or(listed.as_array()).expect("fits").clone();
    let id = listed[0]["id"].as_str().or(listed[0]["fit_id"].as_str()).expect("an id");
    let all = said(&data, &["export"]);
    let used = said(&data, &["export", "--fit", id]);
    assert_eq!(used.lines().collect::<Vec<_>>(), all.lines().take(2).collect::<Vec<_>>());
    let shown = object(&data, &["show", id]);
    assert_eq!((&shown["trajectories"], &shown["sources"][0]["trajectories"]), (&json!(2), &json!(2)));
    assert_eq!(shown["trajectories_digest"].as_str().map(str::len), Some(64));
    // What is deleted since is passed over.
    let first: Value = serde_json::from_str(all.lines().next().expect("a line")).expect("JSON");
    let gone = first["id"].as_str().expect("an id");
    said(&data, &["delete", "--id", gone, "--yes"]);
    assert_eq!(said(&data, &["export", "--fit", &id[..8]]).lines().count(), 1);
    let error = failed(&data, &["export", "--fit", "00000000-0000-0000-0000-000000000000"], 1);
    assert!(error.contains("there is no fit"), "{error}");
    failed(&data, &["export", "--fit", "xyz"], 2);
}
