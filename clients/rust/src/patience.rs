//! Waiting that ends, at no cost to what does not keep anybody waiting.
//!
//! A timer costs more to set than a step has to spare. So there is one for all waits: armed for the end of some wait, and when
//! it fires, armed anew for the end of the present one.

use crate::ClientError;
use std::{
    future::{Future, poll_fn},
    pin::{Pin, pin},
    task::Poll,
    thread,
    time::{Duration, Instant},
};
use tokio::{
    runtime::{Handle, RuntimeFlavor},
    task::yield_now,
    time::{Sleep, sleep_until},
};

/// Beyond it nobody can tell.
const LONGEST: Duration = Duration::from_hours(365 * 24);

/// However often it was looked in vain, it is looked again after two to this power of waits.
const MOST_IN_VAIN: u32 = 10;
/// Where giving way to the other threads of the core takes longer, there was one.
const SOMEBODY: Duration = Duration::from_micros(3);

/// Waits so long and no longer.
#[derive(Debug)]
pub(crate) struct Patience {
    most: Duration,
    timer: Option<Pin<Box<Sleep>>>,
    spin: Spin,
}

impl Patience {
    /// Waits for `most`, the first `spin` of it awake.
    pub fn new(most: Duration, spin: Duration) -> Self {
        Self { most: most.min(LONGEST), timer: None, spin: Spin::new(spin) }
    }

    /// Waits for something.
    ///
    /// # Errors
    /// It did not come in time.
    pub async fn wait<T>(&mut self, something: impl Future<Output = T>) -> Result<T, ClientError> {
        let mut something = pin!(something);
        if let Poll::Ready(output) = now(something.as_mut()).await {
            return Ok(output);
        }
        if self.spin.may()
            && let Some(output) = self.spin.wait(something.as_mut()).await
        {
            return Ok(output);
        }
        let end = Instant::now() + self.most;
        let mut was_asked = true;
        poll_fn(|cx| {
            if !std::mem::take(&mut was_asked)
                && let Poll::Ready(output) = something.as_mut().poll(cx)
            {
                return Poll::Ready(Ok(output));
            }
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

/// Whether it is there now.
async fn now<T>(mut something: Pin<&mut impl Future<Output = T>>) -> Poll<T> {
    poll_fn(|cx| Poll::Ready(something.as_mut().poll(cx))).await
}

/// Looks for what is waited for instead of sleeping, for a moment, where that has paid before and no other thread wants the
/// core: to wake a thread on a halted core takes several times as long as a step does (docs/PERFORMANCE.md).
#[derive(Debug)]
struct Spin {
    most: Duration,
    in_vain: u32,
    /// Waits that are to be slept through.
    asleep: u32,
    is_alone: fn() -> bool,
}

/// Lets whoever is ready on this core go first; false where there was somebody, such as the one who is to answer.
fn is_alone() -> bool {
    let begun = Instant::now();
    thread::yield_now();
    begun.elapsed() < SOMEBODY
}

impl Spin {
    fn new(most: Duration) -> Self {
        Self { most, in_vain: 0, asleep: 0, is_alone }
    }

    /// True where this wait is one to look in. On a runtime of several threads it never is: another may have what there is
    /// to do.
    fn may(&mut self) -> bool {
        if self.asleep > 0 {
            self.asleep -= 1;
            return false;
        }
        !self.most.is_zero()
            && Handle::try_current().is_ok_and(|runtime| runtime.runtime_flavor() == RuntimeFlavor::CurrentThread)
    }

    async fn wait<T>(&mut self, mut something: Pin<&mut impl Future<Output = T>>) -> Option<T> {
        let begun = Instant::now();
        loop {
            let is_alone = (self.is_alone)();
            // Comes back when all that was ready has run and the operating system was asked for what came meanwhile.
            yield_now().await;
            let found = now(something.as_mut()).await;
            if found.is_ready() && is_alone {
                self.in_vain = 0;
            } else if !is_alone || begun.elapsed() >= self.most {
                self.in_vain = (self.in_vain + 1).min(MOST_IN_VAIN);
                self.asleep = (1 << self.in_vain) - 1;
            } else {
                continue;
            }
            return match found {
                Poll::Ready(output) => Some(output),
                Poll::Pending => None,
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::{pending, ready};
    use tokio::time::sleep;

    const SPIN: Duration = Duration::from_millis(1);

    #[tokio::test]
    async fn every_wait_has_its_own_end() {
        let mut patience = Patience::new(Duration::from_millis(150), Duration::ZERO);
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
        assert_eq!(Patience::new(Duration::MAX, Duration::ZERO).wait(sleep(Duration::from_millis(5))).await, Ok(()));
    }

    #[tokio::test]
    async fn looks_ever_more_rarely_in_vain_and_always_where_it_pays() {
        let mut spin = Spin { is_alone: || true, ..Spin::new(SPIN) };
        for in_vain in (1..=MOST_IN_VAIN).chain([MOST_IN_VAIN]) {
            assert!(spin.may());
            assert_eq!(spin.wait(pin!(pending::<()>())).await, None);
            let mut asleep = 0;
            while !spin.may() {
                asleep += 1;
            }
            assert_eq!(asleep, (1 << in_vain) - 1);
        }
        spin.most = Duration::from_mins(1);
        for _ in 0..3 {
            assert!(spin.may());
            assert_eq!(spin.wait(pin!(yield_now())).await, Some(()));
        }
        // Where somebody else is there, even what comes at once is no reason to look again.
        spin.is_alone = || false;
        assert_eq!(spin.wait(pin!(ready(()))).await, Some(()));
        assert!(!spin.may());
        assert!(!Spin::new(Duration::ZERO).may());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn sleeps_where_others_may_have_something_to_do() {
        assert!(!Spin::new(SPIN).may());
    }
}
