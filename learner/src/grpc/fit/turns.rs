//! Whose turn it is: round robin between callers, in the order of arrival within one.
//!
//! Each that waits has a round; those of a lower round come first, and within a round those that came first. A caller's next
//! goes into the round after its last, or into the present one where it had none: start-time fair queueing with jobs of
//! equal cost. So a place in the queue is a rank, and one that has a single fit waits for one fit of each other caller at
//! most, however many those have.
//!
//! Invariants: there are never more than `limit` that wait; where callers are told apart, one of them alone cannot take all
//! places; whoever leaves gives its round to those of its caller behind it. Deliberately absent: threads and clocks.

use mazeway_serving::Caller;
use std::collections::{BTreeMap, HashMap};

/// Names one that waits or runs.
pub type Ticket = u64;
/// What those that wait are ordered by.
type Key = (u64, Ticket);

/// Why there is no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Full {
    /// All callers together have as many as may wait.
    Queue {
        /// How many that is.
        limit: usize,
    },
    /// This caller has as many waiting as leaves room for others.
    Share {
        /// How many it has.
        waiting: usize,
    },
    /// This caller has as many, waiting or running, as it may.
    Quota {
        /// How many that is.
        limit: usize,
    },
}

/// One that waits.
#[derive(Debug)]
struct Waiting<T> {
    caller: Caller,
    work: T,
}

/// What is known of a caller that has something here.
#[derive(Debug, Default)]
struct Part {
    /// Keys of what waits, in order.
    waiting: Vec<Key>,
    running: usize,
    /// Round that its next goes into, if that is not past by then.
    next: u64,
}

/// Those that wait, and how many run.
#[derive(Debug)]
pub struct Turns<T> {
    limit: usize,
    waiting: BTreeMap<Key, Waiting<T>>,
    callers: HashMap<Caller, Part>,
    /// Round of the latest that began.
    round: u64,
    next: Ticket,
}

impl<T> Turns<T> {
    /// At most `limit` wait.
    pub fn new(limit: usize) -> Self {
        Self { limit, waiting: BTreeMap::new(), callers: HashMap::new(), round: 0, next: 0 }
    }

    /// Takes a place. As many as there are `idle` threads are about to begin and do not count among those that wait; `quota`
    /// is how many the caller may have, waiting and running.
    pub fn join(&mut self, caller: &Caller, quota: Option<usize>, idle: usize, work: T) -> Result<Ticket, Full> {
        let total = self.waiting.len();
        let (waiting, running, next) = match self.callers.get(caller) {
            Some(part) => (part.waiting.len(), part.running, part.next),
            None => (0, 0, 0),
        };
        if let Some(limit) = quota.filter(|&limit| waiting + running >= limit) {
            return Err(Full::Quota { limit });
        }
        if idle <= total {
            let total = total - idle;
            if total >= self.limit {
                return Err(Full::Queue { limit: self.limit });
            }
            // As much as is left for others: one caller gets half of the places, two a third each, and so on.
            if !caller.name().is_empty() && waiting > 0 && waiting >= self.limit - total {
                return Err(Full::Share { waiting });
            }
        }
        let round = self.round.max(next);
        let key = (round, self.next);
        self.next += 1;
        let part = self.callers.entry(caller.clone()).or_default();
        part.waiting.push(key);
        part.next = round + 1;
        self.waiting.insert(key, Waiting { caller: caller.clone(), work });
        Ok(key.1)
    }

    /// The next, which now runs.
    pub fn begin(&mut self) -> Option<(Ticket, Caller, T)> {
        let (key, Waiting { caller, work }) = self.waiting.pop_first()?;
        self.round = key.0;
        if let Some(part) = self.callers.get_mut(&caller) {
            part.waiting.retain(|waiting| *waiting != key);
            part.running += 1;
        }
        Some((key.1, caller, work))
    }

    /// One of a caller's no longer runs.
    pub fn end(&mut self, caller: &Caller) {
        if let Some(part) = self.callers.get_mut(caller) {
            part.running = part.running.saturating_sub(1);
        }
        self.forget();
    }

    /// Gives up a place; true where it was one and not running yet.
    pub fn leave(&mut self, caller: &Caller, ticket: Ticket) -> bool {
        let Some(part) = self.callers.get_mut(caller) else { return false };
        let Some(index) = part.waiting.iter().position(|key| key.1 == ticket) else { return false };
        let mut freed = part.waiting.remove(index);
        self.waiting.remove(&freed);
        for key in &mut part.waiting[index..] {
            let moved = (freed.0, key.1);
            if let Some(waiting) = self.waiting.remove(key) {
                self.waiting.insert(moved, waiting);
            }
            freed = std::mem::replace(key, moved);
        }
        part.next = freed.0;
        self.forget();
        true
    }

    /// A caller that has nothing left and whose rounds are past is as good as a new one; where nobody waits all rounds are.
    fn forget(&mut self) {
        let (nobody_waits, round) = (self.waiting.is_empty(), self.round);
        self.callers
            .retain(|_, part| !part.waiting.is_empty() || part.running > 0 || (part.next > round && !nobody_waits));
    }

    /// How many wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// What waits, in the order of its turns.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.waiting.values().map(|waiting| &waiting.work)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn caller(name: &str) -> Caller {
        Caller::named(name)
    }

    fn join(turns: &mut Turns<String>, name: &str, number: u32) -> Ticket {
        turns.join(&caller(name), None, 0, format!("{name}{number}")).expect("a place")
    }

    fn order(turns: &mut Turns<String>) -> String {
        let mut order = Vec::new();
        while let Some((_, caller, work)) = turns.begin() {
            order.push(work);
            turns.end(&caller);
        }
        order.join(" ")
    }

    #[test]
    fn callers_take_turns_and_each_keeps_its_order() {
        let mut turns = Turns::new(100);
        for number in 0..4 {
            join(&mut turns, "a", number);
        }
        for number in 0..2 {
            join(&mut turns, "b", number);
        }
        join(&mut turns, "c", 0);
        assert_eq!(turns.iter().map(String::as_str).collect::<Vec<_>>().join(" "), "a0 b0 c0 a1 b1 a2 a3");
        assert_eq!(order(&mut turns), "a0 b0 c0 a1 b1 a2 a3");
    }

    #[test]
    fn whoever_comes_late_waits_for_no_more_than_one_of_each_other() {
        let mut turns = Turns::new(100);
        for number in 0..50 {
            join(&mut turns, "a", number);
        }
        // Some run already.
        for _ in 0..7 {
            turns.begin().expect("one");
        }
        join(&mut turns, "b", 0);
        join(&mut turns, "b", 1);
        let first: Vec<_> = (0..4).map(|_| turns.begin().expect("one").2).collect();
        assert_eq!(first, ["b0", "a7", "b1", "a8"]);
    }

    #[test]
    fn whoever_comes_back_at_once_goes_behind_those_that_waited_meanwhile() {
        let mut turns = Turns::new(100);
        for number in 0..3 {
            join(&mut turns, "a", number);
        }
        let mut first = Vec::new();
        for number in 0..3 {
            join(&mut turns, "b", number);
            let (_, caller, work) = turns.begin().expect("one");
            turns.end(&caller);
            first.push(work);
        }
        assert_eq!(first, ["a0", "b0", "a1"]);
    }

    #[test]
    fn one_that_leaves_gives_its_round_to_those_behind_it() {
        let mut turns = Turns::new(100);
        let tickets: Vec<_> = (0..4).map(|number| join(&mut turns, "a", number)).collect();
        join(&mut turns, "b", 0);
        join(&mut turns, "b", 1);
        assert!(turns.leave(&caller("a"), tickets[0]));
        assert!(!turns.leave(&caller("a"), tickets[0]), "once");
        assert!(turns.leave(&caller("a"), tickets[2]));
        join(&mut turns, "a", 4);
        assert_eq!(order(&mut turns), "a1 b0 a3 b1 a4");
        assert!(turns.callers.is_empty(), "nothing is kept of callers that have nothing here");
    }

    #[test]
    fn places_are_limited_in_all_and_one_caller_leaves_room_for_others() {
        let mut turns = Turns::new(4);
        for number in 0..2 {
            join(&mut turns, "a", number);
        }
        let more = |turns: &mut Turns<String>, name: &str, idle| turns.join(&caller(name), None, idle, String::new());
        assert_eq!(more(&mut turns, "a", 0), Err(Full::Share { waiting: 2 }));
        join(&mut turns, "b", 0);
        assert_eq!(more(&mut turns, "b", 0), Err(Full::Share { waiting: 1 }));
        join(&mut turns, "c", 0);
        assert_eq!(more(&mut turns, "d", 0), Err(Full::Queue { limit: 4 }));
        // One that begins at once takes no place.
        more(&mut turns, "d", 5).expect("no place is needed");
        // Where nobody is told apart, nobody is kept for.
        let mut turns = Turns::new(3);
        for number in 0..3 {
            join(&mut turns, "", number);
        }
        assert_eq!(more(&mut turns, "", 0), Err(Full::Queue { limit: 3 }));
    }

    #[test]
    fn a_quota_counts_what_waits_and_what_runs() {
        let mut turns = Turns::new(100);
        let ask = |turns: &mut Turns<u32>| turns.join(&caller("a"), Some(2), 0, 0);
        let (first, _) = (ask(&mut turns).expect("one"), ask(&mut turns).expect("two"));
        assert_eq!(ask(&mut turns), Err(Full::Quota { limit: 2 }));
        assert_eq!(turns.begin().expect("the first").0, first);
        assert_eq!(ask(&mut turns), Err(Full::Quota { limit: 2 }), "one runs, one waits");
        turns.end(&caller("a"));
        ask(&mut turns).expect("a place is free");
    }

    proptest! {
        /// Whatever comes, goes and ends: nobody is lost, and between two turns of one caller no other has more than two.
        #[test]
        fn no_caller_is_passed_over(steps in proptest::collection::vec((0_u8..4, 0_usize..4), 0..200)) {
            let names = ["a", "b", "c", "d"].map(caller);
            let mut turns = Turns::new(usize::MAX);
            let mut waiting: Vec<Vec<Ticket>> = vec![Vec::new(); 4];
            let mut passed = [[0_u32; 4]; 4];
            for (what, who) in steps {
                match what {
                    0 | 1 => waiting[who].push(turns.join(&names[who], None, 0, who).expect("a place")),
                    2 => if let Some(ticket) = waiting[who].pop() {
                        prop_assert!(turns.leave(&names[who], ticket));
                        // Who waits for nothing is passed over by nobody.
                        if waiting[who].is_empty() {
                            passed[who] = [0; 4];
                        }
                    },
                    _ => if let Some((ticket, caller, work)) = turns.begin() {
                        prop_assert_eq!(waiting[work].remove(0), ticket, "in order");
                        passed[work] = [0; 4];
                        for other in (0..4).filter(|&other| other != work) {
                            if waiting[other].is_empty() {
                                passed[other] = [0; 4];
                            } else {
                                passed[other][work] += 1;
                                prop_assert!(passed[other][work] <= 2);
                            }
                        }
                        turns.end(&caller);
                    },
                }
                prop_assert_eq!(turns.len(), waiting.iter().map(Vec::len).sum::<usize>());
            }
        }
    }
}
