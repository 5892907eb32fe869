//! Waiting that ends, at no cost to what does not keep anybody waiting.
//!
//! A timer costs more to set than a step has to spare. So there is one for all waits: armed for the end of some wait, and when
//! it fires, armed anew for the end of the present one.

use crate::ClientError;
use std::{
    future::{Future, poll_fn},
    pin::{Pin, pin},
    task::Poll,
    time::{Duration, Instant},
};
use tokio::time::{Sleep, sleep_until};

/// Beyond it nobody can tell.
const LONGEST: Duration = Duration::from_hours(365 * 24);

/// Waits so long and no longer.
#[derive(Debug)]
pub(crate) struct Patience {
    most: Duration,
    timer: Option<Pin<Box<Sleep>>>,
}

impl Patience {
    pub fn new(most: Duration) -> Self {
        Self { most: most.min(LONGEST), timer: None }
    }

    /// Waits for something.
    ///
    /// # Errors
    /// It did not come in time.
    pub async fn wait<T>(&mut self, something: impl Future<Output = T>) -> Result<T, ClientError> {
        let mut something = pin!(something);
        let mut end = None;
        poll_fn(|cx| {
            if let Poll::Ready(output) = something.as_mut().poll(cx) {
                return Poll::Ready(Ok(output));
            }
            let end = *end.get_or_insert_with(|| Instant::now() + self.most);
            let timer = self.timer.get_or_insert_with(|| Box::pin(sleep_until(end.into())));
            while timer.as_mut().poll(cx).is_ready() {
                if Instant::now() >= end {
                    return Poll::Ready(Err(ClientError::Late { secs: self.most.as_secs_f64() }));
                }
                timer.as_mut().reset(end.into());
            }
            Poll::Pending
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::pending;
    use tokio::time::sleep;

    #[tokio::test]
    async fn every_wait_has_its_own_end() {
        let mut patience = Patience::new(Duration::from_millis(150));
        let begun = Instant::now();
        for _ in 0..3 {
            let short = sleep(Duration::from_millis(60));
            assert_eq!(patience.wait(short).await, Ok(()));
        }
        // The timer that the first wait armed has fired meanwhile, which ended none of them.
        assert!(begun.elapsed() >= Duration::from_millis(180));
        let begun = Instant::now();
        assert_eq!(patience.wait(pending::<()>()).await, Err(ClientError::Late { secs: 0.15 }));
        assert!(begun.elapsed() >= Duration::from_millis(150));
    }

    #[tokio::test]
    async fn the_longest_patience_is_no_overflow() {
        assert_eq!(Patience::new(Duration::MAX).wait(sleep(Duration::from_millis(5))).await, Ok(()));
    }
}
