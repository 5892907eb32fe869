//! Numbers that busy threads add to and few read: counters and times, kept apart by thread.
//!
//! Adding is a handful of instructions on memory that no other worker writes to: no lock, no allocation, no cache line that
//! goes from core to core. Reading adds up what the threads have, so a number read while others add may be a moment old.

use prometheus_client::{
    encoding::{EncodeMetric, MetricEncoder, NoLabelSet},
    metrics::{MetricType, TypedMetric},
};
use std::{
    cell::Cell,
    fmt,
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
    },
    time::Duration,
};

/// Parts of a number. Threads beyond that share.
const PARTS: usize = 16;
/// Buckets of times with an upper end.
const BUCKETS: usize = 21;

thread_local! {
    static PART: Cell<usize> = const { Cell::new(usize::MAX) };
}

/// The part of the present thread.
fn part() -> usize {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    PART.with(|part| {
        if part.get() == usize::MAX {
            part.set(NEXT.fetch_add(1, Relaxed) % PARTS);
        }
        part.get()
    })
}

/// Two cache lines, because some processors fetch them in pairs.
#[derive(Debug, Default)]
#[repr(align(128))]
struct Apart<T>(T);

/// A number that only grows. Cloning shares it.
#[derive(Clone, Default)]
pub struct Counter(Arc<[Apart<AtomicU64>; PARTS]>);

impl Counter {
    /// Adds `n`.
    pub fn add(&self, n: u64) {
        self.0[part()].0.fetch_add(n, Relaxed);
    }

    /// What has been added.
    pub fn get(&self) -> u64 {
        self.0.iter().map(|part| part.0.load(Relaxed)).sum()
    }
}

impl fmt::Debug for Counter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Counter").field(&self.get()).finish()
    }
}

impl EncodeMetric for Counter {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        encoder.encode_counter::<NoLabelSet, _, f64>(&self.get(), None)
    }

    fn metric_type(&self) -> MetricType {
        Self::TYPE
    }
}

impl TypedMetric for Counter {
    const TYPE: MetricType = MetricType::Counter;
}

#[derive(Debug, Default)]
struct TimesPart {
    buckets: [AtomicU64; BUCKETS + 1],
    nanos: AtomicU64,
}

/// How long something took, in buckets that double. Cloning shares it.
#[derive(Clone)]
pub struct Times {
    parts: Arc<[Apart<TimesPart>; PARTS]>,
    shift: u32,
}

impl Times {
    /// Buckets up to 2^`shift` ns, twice that, and so on, a million times that, and beyond.
    fn from_nanos(shift: u32) -> Self {
        Self { parts: Arc::default(), shift }
    }

    /// From a microsecond to a second, for steps.
    pub fn of_steps() -> Self {
        Self::from_nanos(10)
    }

    /// From 16 microseconds to 17 seconds, for what waits for a disk.
    pub fn of_disks() -> Self {
        Self::from_nanos(14)
    }

    /// From 66 microseconds to 69 seconds, for calls.
    pub fn of_calls() -> Self {
        Self::from_nanos(16)
    }

    /// From 8 milliseconds to two hours, for fits.
    pub fn of_fits() -> Self {
        Self::from_nanos(23)
    }

    /// One took so long.
    pub fn observe(&self, took: Duration) {
        let nanos = u64::try_from(took.as_nanos()).unwrap_or(u64::MAX);
        // The first bucket whose upper end is not below it.
        let bucket = (u64::BITS - (nanos.saturating_sub(1) >> self.shift).leading_zeros()) as usize;
        let part = &self.parts[part()].0;
        part.buckets[bucket.min(BUCKETS)].fetch_add(1, Relaxed);
        part.nanos.fetch_add(nanos, Relaxed);
    }

    /// How many there were.
    pub fn count(&self) -> u64 {
        self.buckets().iter().map(|(_, count)| count).sum()
    }

    fn secs(&self) -> f64 {
        self.parts.iter().map(|part| part.0.nanos.load(Relaxed) as f64).sum::<f64>() / 1e9
    }

    /// Upper ends in seconds, and how many are in each and in no lower one.
    fn buckets(&self) -> [(f64, u64); BUCKETS + 1] {
        std::array::from_fn(|bucket| {
            // Written as +Inf, which is the bucket of all of them.
            let end =
                if bucket == BUCKETS { f64::INFINITY } else { (1_u64 << (self.shift + bucket as u32)) as f64 / 1e9 };
            (end, self.parts.iter().map(|part| part.0.buckets[bucket].load(Relaxed)).sum())
        })
    }
}

impl fmt::Debug for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Times").field("count", &self.count()).field("secs", &self.secs()).finish()
    }
}

impl EncodeMetric for Times {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        let buckets = self.buckets();
        let count = buckets.iter().map(|(_, count)| count).sum();
        encoder.encode_histogram::<NoLabelSet>(self.secs(), count, &buckets, None)
    }

    fn metric_type(&self) -> MetricType {
        Self::TYPE
    }
}

impl TypedMetric for Times {
    const TYPE: MetricType = MetricType::Histogram;
}

/// A number that is asked for when it is read.
pub struct Reading<F>(pub F);

impl<F> fmt::Debug for Reading<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Reading")
    }
}

impl<F: Fn() -> i64> EncodeMetric for Reading<F> {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        encoder.encode_gauge(&(self.0)())
    }

    fn metric_type(&self) -> MetricType {
        MetricType::Gauge
    }
}

/// A number that only grows and is asked for when it is read.
pub struct Growing<F>(pub F);

impl<F> fmt::Debug for Growing<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Growing")
    }
}

impl<F: Fn() -> u64> EncodeMetric for Growing<F> {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        encoder.encode_counter::<NoLabelSet, _, f64>(&(self.0)(), None)
    }

    fn metric_type(&self) -> MetricType {
        MetricType::Counter
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread;

    #[test]
    fn nothing_that_threads_add_is_lost() {
        let (counter, times) = (Counter::default(), Times::of_steps());
        thread::scope(|scope| {
            for _ in 0..2 * PARTS {
                scope.spawn(|| {
                    for _ in 0..1000 {
                        counter.add(3);
                        times.observe(Duration::from_micros(2));
                    }
                });
            }
        });
        assert_eq!((counter.get(), times.count()), (96_000, 32_000));
        assert!((times.secs() - 0.064).abs() < 1e-9);
    }

    #[test]
    fn times_fall_into_the_first_bucket_that_holds_them() {
        for (nanos, bucket) in [(0, 0), (1024, 0), (1025, 1), (2048, 1), (2049, 2), (1 << 30, 20), ((1 << 30) + 1, 21)]
        {
            let times = Times::of_steps();
            times.observe(Duration::from_nanos(nanos));
            let found = times.buckets().iter().position(|(_, count)| *count == 1);
            assert_eq!(found, Some(bucket), "{nanos}");
            assert!(times.buckets()[bucket].0 >= nanos as f64 / 1e9);
        }
        let times = Times::of_fits();
        times.observe(Duration::MAX);
        assert_eq!(times.buckets()[BUCKETS].1, 1);
    }
}
