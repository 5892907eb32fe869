//! Iterative solution of one policy after another, with the preconditioner that has paid so far.
//!
//! The rule is that of renting until the rent has reached the price (Karlin, Manasse, Rudolph & Sleator 1988): whatever
//! comes, no more than about twice the operations of the better choice are spent. Invariant: passes are bounded, whatever
//! the model.

use super::direct::{Factor, Kept, Symbolic};
use super::iterative::{Incomplete, Iterated, Patience, bicgstab};
use super::pattern::Matrix;

/// Multiplications that a whole factorisation may take, some seconds; its fill is below a twentieth of that.
const BEARABLE_MULTIPLICATIONS: u64 = 4_000_000_000;
/// Iterations after which an order of elimination is looked for, to know the price.
const ENOUGH_TO_ASK: u64 = 100;
/// Iterations with the factorisation of an earlier policy, or of the present one.
const LASTING_ITERATIONS: u32 = 30;
/// Entries of M that iterations and sweeps with the incomplete factorisation visit at most in one solution, some seconds.
const BEARABLE_VISITS: u64 = 4_000_000_000;
/// Fewest iterations and sweeps after which that is given up.
const LEAST_PASSES: u64 = 1000;

/// Solves with M of a policy, then of the next. Its factors are kept as `V`: what they lack in precision the iteration makes
/// up for, and half the bytes are read in half the time.
#[derive(Default)]
pub(super) struct Iterative<V> {
    incomplete: Incomplete,
    whole: Whole<V>,
    /// Operations spent on iterations beyond those that the other choice would have taken too.
    spent: u64,
}

/// What is known of the whole factorisation.
#[derive(Default)]
enum Whole<V> {
    /// Nothing.
    #[default]
    Unknown,
    /// It is not bearable.
    Unbearable,
    /// Its order and so its price.
    Priced(Symbolic),
    /// It is made, of the present policy or of an earlier one.
    Made { factor: Box<Factor<V>>, present: bool },
}

impl<V: Kept> Iterative<V> {
    /// M has become that of another policy.
    pub(super) fn set_policy(&mut self, matrix: &Matrix) {
        self.consider(matrix);
        match &mut self.whole {
            Whole::Made { present, .. } => *present = false,
            _ => self.incomplete.factorise(matrix),
        }
    }

    /// x of M x = b or Mᵀ x = b, to a residual of `tolerance` relative to b where the passes suffice.
    pub(super) fn solve(
        &mut self,
        matrix: &Matrix,
        b: &[f64],
        transposed: bool,
        tolerance: f64,
        start: Option<&[f64]>,
    ) -> Vec<f64> {
        let begun = if matches!(self.whole, Whole::Made { .. }) {
            start.map(<[f64]>::to_vec)
        } else {
            let patience = Patience { most: self.affordable(matrix), minds_pace: false };
            let iterated = bicgstab((matrix, &self.incomplete), b, transposed, tolerance, start, patience);
            self.spent += u64::from(iterated.iterations) * visits(matrix.n_entries());
            if iterated.converged {
                return iterated.x;
            }
            tracing::debug!(states = b.len(), iterations = iterated.iterations, "the iteration did not converge");
            self.buy(matrix);
            Some(iterated.x)
        };
        if !matches!(self.whole, Whole::Made { .. }) {
            let passes = (BEARABLE_VISITS / visits(matrix.n_entries())).max(LEAST_PASSES);
            return self.incomplete.sweeps(matrix, b, transposed, begun.unwrap_or_default(), tolerance, passes);
        }
        self.solve_whole(matrix, b, transposed, tolerance, begun)
    }

    fn solve_whole(
        &mut self,
        matrix: &Matrix,
        b: &[f64],
        transposed: bool,
        tolerance: f64,
        mut start: Option<Vec<f64>>,
    ) -> Vec<f64> {
        let Whole::Made { factor, present } = &mut self.whole else { return start.unwrap_or_default() };
        let price = factor.symbolic().multiplications();
        if !*present {
            // as many iterations as a new one costs, and no more
            let most = (price / visits(factor.symbolic().n_entries())).clamp(4, u64::from(LASTING_ITERATIONS)) as u32;
            let (old, patience) = (&**factor, Patience { most, minds_pace: true });
            let Iterated { x, converged, iterations } =
                bicgstab((matrix, old), b, transposed, tolerance, start.as_deref(), patience);
            // one iteration would be needed with a new one too
            self.spent += u64::from(iterations.saturating_sub(1)) * visits(old.symbolic().n_entries());
            if converged {
                return x;
            }
            start = Some(x);
            factor.factorise(matrix);
            *present = true;
            self.spent = 0;
        }
        let patience = Patience { most: LASTING_ITERATIONS, minds_pace: false };
        bicgstab((matrix, &**factor), b, transposed, tolerance, start.as_deref(), patience).x
    }

    /// Iterations with the incomplete factorisation after which a whole one is the better choice.
    fn affordable(&self, matrix: &Matrix) -> u32 {
        let price = match &self.whole {
            Whole::Unbearable => BEARABLE_VISITS,
            Whole::Priced(symbolic) => symbolic.multiplications(),
            _ => ENOUGH_TO_ASK * visits(matrix.n_entries()),
        };
        (price / visits(matrix.n_entries())).clamp(ENOUGH_TO_ASK, u64::from(u32::MAX)) as u32
    }

    /// Between two policies: makes, or makes anew, a factorisation whose price was spent otherwise.
    fn consider(&mut self, matrix: &Matrix) {
        match &mut self.whole {
            Whole::Unbearable => {}
            Whole::Unknown if self.spent < ENOUGH_TO_ASK * visits(matrix.n_entries()) => {}
            Whole::Unknown => self.ask(matrix),
            Whole::Priced(symbolic) if self.spent < symbolic.multiplications() => {}
            Whole::Priced(_) => self.buy(matrix),
            Whole::Made { factor, present } => {
                if self.spent >= factor.symbolic().multiplications() {
                    factor.factorise(matrix);
                    *present = true;
                    self.spent = 0;
                }
            }
        }
    }

    fn ask(&mut self, matrix: &Matrix) {
        self.whole = match Symbolic::of(matrix, BEARABLE_MULTIPLICATIONS) {
            Some(symbolic) => Whole::Priced(symbolic),
            None => Whole::Unbearable,
        };
    }

    /// Makes a factorisation now, if it is bearable.
    pub(super) fn buy(&mut self, matrix: &Matrix) {
        if matches!(self.whole, Whole::Unknown) {
            self.ask(matrix);
        }
        self.whole = match std::mem::take(&mut self.whole) {
            Whole::Priced(symbolic) => {
                let mut factor = Box::new(Factor::new(symbolic));
                factor.factorise(matrix);
                self.spent = 0;
                Whole::Made { factor, present: true }
            }
            other => other,
        };
    }
}

/// Operations of an iteration: two products with M and two with a preconditioner of so many entries, and the vectors.
fn visits(n_entries: usize) -> u64 {
    4 * n_entries.max(1) as u64
}
