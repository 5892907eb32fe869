//! A model that arrives in parts: a header, then blocks of rows in order, without gaps.

use super::status::CallError;
use crate::{
    config::Limits,
    store::{Model, Rows, check_header},
};
use mazeway_proto::env::{ModelHeader, ModelPart, RowBlock, model_part::Part};

/// Puts parts together. Invariant: what it holds is within the limits, whatever was sent.
#[derive(Debug, Default)]
pub struct ModelBuilder {
    header: Option<ModelHeader>,
    row_lengths: Vec<u8>,
    next_states: Vec<u8>,
    probabilities: Vec<u8>,
    visit_counts: Vec<u8>,
}

impl ModelBuilder {
    /// Takes the next part.
    pub fn add(&mut self, part: Option<ModelPart>, limits: &Limits) -> Result<(), CallError> {
        match (part.and_then(|part| part.part), &self.header) {
            (None, _) => Err(CallError::field("part", "expected a header or rows, got neither")),
            (Some(Part::Header(_)), Some(_)) => {
                Err(CallError::field("part.header", "expected one header, got another"))
            }
            (Some(Part::Header(header)), None) => self.add_header(header, limits),
            (Some(Part::Rows(_)), None) => Err(CallError::field("part.rows", "expected the header first, got rows")),
            (Some(Part::Rows(rows)), Some(_)) => self.add_rows(&rows, limits),
        }
    }

    fn add_header(&mut self, header: ModelHeader, limits: &Limits) -> Result<(), CallError> {
        check_header(&header).map_err(|error| error.within("part"))?;
        let (limit, got) = (limits.max_model_rows, u64::from(header.n_states) * u64::from(header.n_actions));
        if got > limit {
            return Err(CallError::Limit { field: "part.header.n_states".into(), what: "rows", limit, got });
        }
        self.header = Some(header);
        Ok(())
    }

    fn add_rows(&mut self, rows: &RowBlock, limits: &Limits) -> Result<(), CallError> {
        let expected = self.row_lengths.len() / 4;
        if rows.first_row as usize != expected {
            let message = format!("expected row {expected} next, got {}", rows.first_row);
            return Err(CallError::field("part.rows.first_row", message));
        }
        let got = ((self.next_states.len() + rows.next_states.len()) / 4) as u64;
        if got > limits.max_model_transitions {
            let (field, limit) = ("part.rows.next_states".into(), limits.max_model_transitions);
            return Err(CallError::Limit { field, what: "transitions", limit, got });
        }
        let n_rows = self.header.as_ref().map_or(0, |h| u64::from(h.n_states) * u64::from(h.n_actions));
        let arrays = [
            ("row_lengths", &rows.row_lengths, &mut self.row_lengths, 4, n_rows),
            ("next_states", &rows.next_states, &mut self.next_states, 4, limits.max_model_transitions),
            ("probabilities", &rows.probabilities, &mut self.probabilities, 8, limits.max_model_transitions),
            ("visit_counts", &rows.visit_counts, &mut self.visit_counts, 8, n_rows),
        ];
        for (field, part, whole, size, limit) in arrays {
            let got = (whole.len() + part.len()) as u64 / size;
            if !(part.len() as u64).is_multiple_of(size) || got > limit {
                let message = format!("expected {size} bytes an entry and {limit} entries in all at most, got {got}");
                return Err(CallError::field(format!("part.rows.{field}"), message));
            }
            whole.extend_from_slice(part);
        }
        Ok(())
    }

    /// Checks the whole and names it. Takes time that grows with the model.
    pub fn finish(self) -> Result<Model, CallError> {
        let header = self.header.ok_or_else(|| CallError::field("part.header", "expected a header, got no part"))?;
        let rows = Rows {
            row_lengths: self.row_lengths.into(),
            next_states: self.next_states.into(),
            probabilities: self.probabilities.into(),
            visit_counts: self.visit_counts.into(),
        };
        Ok(Model::new(header, rows).map_err(|error| error.within("part"))?)
    }
}
