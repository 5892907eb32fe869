//! Trying again what a broken connection cut off, where that changes nothing.
//!
//! Pauses grow and are drawn at random within their length, so that many clients of a server that comes back do not all come
//! at once. Nothing is tried again that might be carried out twice.

use crate::ClientError;
use std::time::{Duration, Instant};
use tokio::time::sleep;
use tonic::Code;

/// How long a server that went away is waited for, unless asked otherwise.
pub(crate) const RECONNECT: Duration = Duration::from_secs(10);

/// Growing pauses until it is time to give up.
#[derive(Debug)]
pub(crate) struct Backoff {
    pause: Duration,
    longest: Duration,
    give_up: Instant,
}

impl Backoff {
    pub fn new(first: Duration, longest: Duration, within: Duration) -> Self {
        Self { pause: first, longest, give_up: Instant::now() + within }
    }

    /// Pauses; false where there is no time left for it.
    pub async fn pause(&mut self) -> bool {
        let pause = self.pause.mul_f64(0.5 + 0.5 * jitter());
        if Instant::now() + pause > self.give_up {
            return false;
        }
        sleep(pause).await;
        self.pause = (self.pause * 2).min(self.longest);
        true
    }
}

/// From 0 to 1. Nothing but pauses depends on it.
fn jitter() -> f64 {
    use std::hash::{BuildHasher as _, RandomState};
    // The standard library's hasher is seeded at random.
    (RandomState::new().hash_one(0) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Asks until there is an answer, a refusal, or no time left.
pub(crate) async fn reconnecting<T>(ask: impl AsyncFn() -> Result<T, ClientError>) -> Result<T, ClientError> {
    let mut backoff = Backoff::new(Duration::from_millis(10), Duration::from_secs(1), RECONNECT);
    loop {
        // Boxed: callers need not carry every call that may be tried again.
        match Box::pin(ask()).await {
            Err(ClientError::Status { code: Code::Unavailable, message, field }) => {
                if !backoff.pause().await {
                    return Err(ClientError::Status { code: Code::Unavailable, message, field });
                }
            }
            outcome => return outcome,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn pauses_grow_up_to_their_longest_and_end_in_time() {
        let within = Duration::from_hours(1);
        let mut backoff = Backoff::new(Duration::from_millis(4), Duration::from_millis(16), within);
        for most in [4, 8, 16, 16] {
            let begun = Instant::now();
            assert!(backoff.pause().await);
            // How much longer it took says how busy the machine is.
            let took = begun.elapsed();
            assert!(took >= Duration::from_millis(most) / 2, "{took:?} of {most} ms");
        }
        assert_eq!(backoff.pause, Duration::from_millis(16));
        assert!(!Backoff::new(Duration::from_millis(10), Duration::from_secs(1), Duration::ZERO).pause().await);
    }

    #[test]
    fn jitter_is_a_share() {
        let drawn: Vec<f64> = (0..100).map(|_| jitter()).collect();
        assert!(drawn.iter().all(|share| (0.0..1.0).contains(share)));
        assert!(drawn.iter().any(|share| *share < 0.5) && drawn.iter().any(|share| *share >= 0.5));
    }
}
