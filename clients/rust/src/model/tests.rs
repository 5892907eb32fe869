use super::*;

/// Two states, two actions, a row a time.
fn model() -> Model {
    let mut model = Model {
        env_id: "Coin-v0".into(),
        model_id: String::new(),
        n_states: 2,
        n_actions: 2,
        state_labels: vec!["heads".into(), "tails".into()],
        action_labels: Vec::new(),
        initial_distribution: vec![0.25, 0.75],
        row_offsets: vec![0, 1, 3, 5, 6],
        next_states: vec![0, 0, 1, 0, 1, 1],
        probabilities: vec![1.0, 0.5, 0.5, 0.1, 0.9, 1.0],
        visit_counts: Some(vec![4, 8, u64::MAX, 0]),
        estimated: true,
        rewards: vec![("greedy".into(), vec![0.0, 1.0, -1.0, 0.5])],
        grid: Some(Grid { rows: 1, columns: 3, cells: vec![0, 2] }),
        features: Some(FeatureTable {
            names: vec!["x".into(), "y".into()],
            domain: FeatureDomain::States,
            values: vec![0.5, -1.0, 0.0, 2.0],
        }),
        terminal_states: Vec::new(),
    };
    model.model_id = model.compute_id();
    model
}

fn collect(parts: impl IntoIterator<Item = pb::ModelPart>) -> Result<Model, ModelError> {
    let mut collector = ModelCollector::default();
    for part in parts {
        collector.push(part)?;
    }
    collector.finish()
}

/// The model's header and its one block, changed, and the field that is refused.
fn refused(change: impl FnOnce(&mut pb::ModelHeader, &mut pb::RowBlock)) -> String {
    let parts: Vec<_> = model().parts().collect();
    let [Some(Part::Header(mut header)), Some(Part::Rows(mut rows))] = [parts[0].part.clone(), parts[1].part.clone()]
    else {
        panic!("expected a header and a block");
    };
    change(&mut header, &mut rows);
    let parts = [Part::Header(header), Part::Rows(rows)].map(|part| pb::ModelPart { part: Some(part) });
    collect(parts).expect_err("refused").field
}

#[test]
fn parts_are_put_together_again() {
    assert_eq!(collect(model().parts()), Ok(model()));
    let anonymous = Model { model_id: String::new(), ..model() };
    assert_eq!(collect(anonymous.parts()), Ok(model()), "an empty id is filled in");
}

#[test]
fn a_large_model_travels_in_blocks() {
    let (n_states, n_actions) = (3000_u32, 4_u32);
    let n_rows = (n_states * n_actions) as usize;
    let mut large = Model {
        n_states,
        n_actions,
        state_labels: Vec::new(),
        initial_distribution: vec![1.0 / f64::from(n_states); n_states as usize],
        row_offsets: (0..=n_rows).collect(),
        next_states: (0..n_rows as u32).map(|row| row % n_states).collect(),
        probabilities: vec![1.0; n_rows],
        visit_counts: None,
        rewards: Vec::new(),
        grid: None,
        features: None,
        terminal_states: Vec::new(),
        ..model()
    };
    large.model_id = large.compute_id();
    let parts: Vec<_> = large.parts().collect();
    assert_eq!(parts.len(), 1 + n_rows.div_ceil(ROWS_A_BLOCK));
    assert_eq!(collect(parts), Ok(large));
}

#[test]
fn a_row_longer_than_a_block_travels_alone() {
    let n_states = 2 * ENTRIES_A_BLOCK as u32;
    let long: Vec<u32> = (0..n_states).collect();
    let mut wide = Model {
        n_states,
        n_actions: 1,
        state_labels: Vec::new(),
        initial_distribution: vec![1.0 / f64::from(n_states); n_states as usize],
        row_offsets: (0..=n_states as usize)
            .map(|row| if row == 0 { 0 } else { n_states as usize + row - 1 })
            .collect(),
        next_states: long.iter().copied().chain(1..n_states).collect(),
        probabilities: long.iter().map(|_| 1.0 / f64::from(n_states)).chain((1..n_states).map(|_| 1.0)).collect(),
        visit_counts: None,
        rewards: Vec::new(),
        grid: None,
        features: None,
        terminal_states: Vec::new(),
        ..model()
    };
    wide.model_id = wide.compute_id();
    assert_eq!(collect(wide.parts()), Ok(wide));
}

#[test]
fn malformed_parts_name_their_field() {
    assert_eq!(refused(|header, _| header.n_states = 0), "header.n_states");
    assert_eq!(refused(|header, _| header.n_actions = u32::MAX), "header.n_states");
    assert_eq!(refused(|header, _| header.n_actions = 1), "header.rewards");
    assert_eq!(refused(|header, _| header.state_labels.truncate(1)), "header.state_labels");
    assert_eq!(refused(|header, _| header.action_labels.push("flip".into())), "header.action_labels");
    assert_eq!(refused(|header, _| header.initial_distribution = pack([0.5, 0.4])), "header.initial_distribution");
    assert_eq!(refused(|header, _| header.rewards[0].values = pack([f64::NAN; 4])), "header.rewards");
    assert_eq!(refused(|header, _| header.grid.as_mut().expect("a grid").columns = 2), "header.grid.cells");
    assert_eq!(refused(|header, _| header.model_id = "0".repeat(64)), "header.model_id");
    assert_eq!(refused(|_, rows| rows.first_row = 1), "rows.first_row");
    assert_eq!(refused(|_, rows| rows.row_lengths = pack([1, 2, 2, 1, 0])), "rows.row_lengths");
    assert_eq!(refused(|_, rows| rows.row_lengths = pack([1, 2, 3])), "rows.next_states");
    assert_eq!(refused(|_, rows| rows.row_lengths = pack([u32::MAX; 4])), "rows.row_lengths");
    assert_eq!(refused(|_, rows| rows.next_states = pack([0, 1, 0, 0, 1, 1])), "rows.next_states");
    assert_eq!(refused(|_, rows| rows.next_states = pack([0, 0, 1, 0, 2, 1])), "rows.next_states");
    assert_eq!(refused(|_, rows| rows.probabilities = pack([1.0, 0.5, 0.4, 0.1, 0.9, 1.0])), "rows.probabilities");
    assert_eq!(refused(|_, rows| rows.probabilities = pack([1.0, 1.5, -0.5, 0.1, 0.9, 1.0])), "rows.probabilities");
    assert_eq!(refused(|_, rows| rows.visit_counts = pack([1_u64])), "rows.visit_counts");
}

#[test]
fn parts_come_in_order() {
    let parts: Vec<_> = model().parts().collect();
    let field = |parts: Vec<pb::ModelPart>| collect(parts).expect_err("refused").field;
    assert_eq!(field(vec![]), "header");
    assert_eq!(field(vec![pb::ModelPart { part: None }]), "part");
    assert_eq!(field(vec![parts[1].clone()]), "rows");
    assert_eq!(field(vec![parts[0].clone(), parts[0].clone()]), "header");
    assert_eq!(field(vec![parts[0].clone()]), "rows");
    assert_eq!(field(vec![parts[0].clone(), parts[1].clone(), parts[1].clone()]), "rows.first_row");
}

#[test]
fn limits_hold_before_memory_is_taken() {
    let mut collector = ModelCollector::new(ModelLimits { max_rows: 3, max_entries: 100 });
    let header = model().parts().next().expect("a header");
    assert_eq!(collector.push(header).expect_err("too many rows").field, "header.n_states");
}

#[test]
fn rows_and_rewards_are_found() {
    let model = model();
    assert_eq!(model.row(1, 0), (&[0, 1][..], &[0.1, 0.9][..]));
    assert_eq!(model.reward("greedy"), Some(&[0.0, 1.0, -1.0, 0.5][..]));
    assert_eq!(model.reward("timid"), None);
}
