//! How long the other end of a model's stream may keep this one waiting.
//!
//! A model takes a permit while it is in memory, so whoever sends or reads one in drops would keep all others from theirs.
//! Time waited for the peer is spent, bytes that went over earn it back: an end that keeps a rate is never given up, one
//! that does not, soon. Time in which this end is at work costs nothing.

use super::status::CallError;
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// Bytes a second that keep a model's stream going, however large the model.
const RATE: f64 = (64 << 10) as f64;

/// What is left of the patience with a peer. Invariant: never more than all of it.
#[derive(Debug)]
pub struct Pace {
    most: Duration,
    left: Duration,
}

impl Pace {
    /// `patience` is how long the peer may do nothing at all.
    pub fn new(patience: Duration) -> Self {
        Self { most: patience, left: patience }
    }

    /// Waits for the peer.
    ///
    /// # Errors
    /// [`CallError::Slow`]: it took more than was left.
    pub async fn wait<T>(&mut self, peer: impl Future<Output = T>) -> Result<T, CallError> {
        let begun = Instant::now();
        let outcome = timeout(self.left, peer).await.map_err(|_| CallError::Slow { patience: self.most })?;
        self.waited(begun.elapsed());
        Ok(outcome)
    }

    fn waited(&mut self, time: Duration) {
        self.left = self.left.saturating_sub(time);
    }

    /// So many bytes went over.
    pub fn moved(&mut self, bytes: usize) {
        self.left = self.left.saturating_add(Duration::from_secs_f64(bytes as f64 / RATE)).min(self.most);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// Of a thousand parts of so many bytes, each after so long, those that are waited for.
    fn taken(bytes: usize, every: Duration) -> usize {
        let mut pace = Pace::new(10 * SECOND);
        let waited_for = |_: &usize| {
            let patient = every <= pace.left;
            pace.waited(every);
            pace.moved(bytes);
            patient
        };
        (0..1000).take_while(waited_for).count()
    }

    #[test]
    fn whoever_keeps_the_rate_may_go_on_and_whoever_drips_may_not() {
        assert_eq!(taken(64 << 10, SECOND), 1000);
        assert_eq!(taken(640 << 10, 9 * SECOND), 1000);
        // Nothing at all, drops, half of the rate.
        assert_eq!(taken(0, 11 * SECOND), 0);
        assert_eq!(taken(1, SECOND), 10);
        assert_eq!(taken(32 << 10, SECOND), 19);
        // What went over fast buys no longer silence later.
        let mut pace = Pace::new(10 * SECOND);
        pace.moved(1 << 30);
        assert_eq!(pace.left, 10 * SECOND);
    }
}
