//! The virtual network: a directed link between every two robots, each with its own dice. A message is delayed, lost
//! alone or in a burst, doubled, held back so that later ones overtake it, refused by a full queue, or blocked by a
//! partition; every fault that fires is counted. Bursts follow Gilbert and Elliott: good and bad spells, both of
//! exponential length, in continuous time.

use crate::dice::Dice;
use crate::faults::FaultCounts;
use core::time::Duration;
use merganser_protocol::time::Instant;
use serde::{Deserialize, Serialize};

/// Bytes of headers around every message, charged against the byte cap.
const HEADER_BYTES: usize = 60;

/// What links are like. Times in ms, shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkOptions {
    /// Least latency.
    pub latency_ms_min: f64,
    /// Mean latency; what exceeds the least is exponential.
    pub latency_ms_mean: f64,
    /// Share of messages lost, one by one.
    pub loss: f64,
    /// Bad spells per minute and link.
    pub bursts_per_min: f64,
    /// Mean length of a bad spell.
    pub burst_ms_mean: f64,
    /// Share of messages lost in a bad spell.
    pub burst_loss: f64,
    /// Share of messages that arrive twice.
    pub duplicate: f64,
    /// Share of messages held back...
    pub reorder: f64,
    /// ...by up to this.
    pub reorder_ms_max: f64,
    /// Share of messages of which a mangled copy arrives as well.
    pub mangle: f64,
    /// Share of messages that arrive once more, up to a minute later.
    pub replay: f64,
    /// Capacity of each link; 0 is unlimited.
    pub bytes_per_sec: f64,
    /// A message that would wait longer than this for its link is dropped.
    pub queue_ms_max: f64,
    /// A question is given up after this.
    pub answer_ms_max: f64,
    /// From the moment two robots can hear each other until they know.
    pub discover_ms: f64,
    /// From the moment they no longer can until they know.
    pub lease_ms: f64,
}

impl Default for NetworkOptions {
    fn default() -> Self {
        Self {
            latency_ms_min: 1.0,
            latency_ms_mean: 5.0,
            loss: 0.0,
            bursts_per_min: 0.0,
            burst_ms_mean: 500.0,
            burst_loss: 0.9,
            duplicate: 0.0,
            reorder: 0.0,
            reorder_ms_max: 200.0,
            mangle: 0.0,
            replay: 0.0,
            bytes_per_sec: 0.0,
            queue_ms_max: 2000.0,
            answer_ms_max: 2000.0,
            discover_ms: 500.0,
            lease_ms: 3000.0,
        }
    }
}

impl NetworkOptions {
    /// The same network after all faults have stopped: only latency is left.
    #[must_use]
    pub fn healed(&self) -> Self {
        Self {
            loss: 0.0,
            bursts_per_min: 0.0,
            duplicate: 0.0,
            reorder: 0.0,
            mangle: 0.0,
            replay: 0.0,
            bytes_per_sec: 0.0,
            ..self.clone()
        }
    }

    /// Every knob's key, value, bounds and remedy, for the scenario's check.
    pub fn ranges(&self) -> [(&'static str, f64, f64, f64, &'static str); 16] {
        let ms = "use 0 to 600000 ms";
        let share = "use a share from 0 to 1";
        [
            ("network.latency_ms_min", self.latency_ms_min, 0.0, 600_000.0, ms),
            ("network.latency_ms_mean", self.latency_ms_mean, self.latency_ms_min, 600_000.0, "use at least the least"),
            ("network.loss", self.loss, 0.0, 1.0, share),
            ("network.bursts_per_min", self.bursts_per_min, 0.0, 6000.0, "use 0 to 6000"),
            ("network.burst_ms_mean", self.burst_ms_mean, 1.0, 600_000.0, "use 1 to 600000 ms"),
            ("network.burst_loss", self.burst_loss, 0.0, 1.0, share),
            ("network.duplicate", self.duplicate, 0.0, 1.0, share),
            ("network.reorder", self.reorder, 0.0, 1.0, share),
            ("network.reorder_ms_max", self.reorder_ms_max, 0.0, 600_000.0, ms),
            ("network.mangle", self.mangle, 0.0, 1.0, share),
            ("network.replay", self.replay, 0.0, 1.0, share),
            ("network.bytes_per_sec", self.bytes_per_sec, 0.0, 1e12, "use 0 (unlimited) to 1e12"),
            ("network.queue_ms_max", self.queue_ms_max, 0.0, 600_000.0, ms),
            ("network.answer_ms_max", self.answer_ms_max, 1.0, 600_000.0, "use 1 to 600000 ms"),
            ("network.discover_ms", self.discover_ms, 0.0, 600_000.0, ms),
            ("network.lease_ms", self.lease_ms, 0.0, 600_000.0, ms),
        ]
    }
}

/// All links of a swarm.
#[derive(Clone, Debug)]
pub struct Network {
    options: NetworkOptions,
    robots: usize,
    seed: u64,
    links: Vec<Link>,
    /// For each robot, those whom its radio reaches, in order; `None`: all of them.
    reach: Option<Vec<Vec<usize>>>,
}

#[derive(Clone, Debug, Default)]
struct Link {
    /// How many faults block it at present.
    blocks: u32,
    /// Made when first used: most links of a large swarm are never in reach.
    air: Option<Box<Air>>,
}

/// What becomes of the messages on a link.
#[derive(Clone, Debug)]
struct Air {
    dice: Dice,
    /// When its queue will be empty.
    free_at: Instant,
    burst: [Instant; 2],
}

impl Network {
    /// Links between `robots` robots.
    pub fn new(options: NetworkOptions, robots: usize, seed: u64) -> Self {
        Self { options, robots, seed, links: vec![Link::default(); robots * robots], reach: None }
    }

    /// The options in force.
    pub fn options(&self) -> &NetworkOptions {
        &self.options
    }

    /// Whom each robot's radio reaches, from now on.
    pub fn set_reach(&mut self, reach: Vec<Vec<usize>>) {
        self.reach = Some(reach);
    }

    /// Whom the radio of `from` reaches, blocked or not, in order.
    pub fn in_reach(&self, from: usize) -> Vec<usize> {
        match &self.reach {
            Some(reach) => reach[from].clone(),
            None => (0..self.robots).filter(|to| *to != from).collect(),
        }
    }

    fn reaches(&self, from: usize, to: usize) -> bool {
        self.reach.as_ref().map_or(from != to, |reach| reach[from].binary_search(&to).is_ok())
    }

    /// Ends loss, bursts, duplication, reordering and caps, and unblocks every link; reach stays what it is.
    pub fn heal(&mut self) {
        self.options = self.options.healed();
        self.links.iter_mut().for_each(|link| link.blocks = 0);
    }

    /// Blocks the link, or takes one block away.
    pub fn block(&mut self, from: usize, to: usize, blocked: bool) {
        let blocks = &mut self.links[from * self.robots + to].blocks;
        *blocks = if blocked { *blocks + 1 } else { blocks.saturating_sub(1) };
    }

    /// Whether messages can pass.
    pub fn is_open(&self, from: usize, to: usize) -> bool {
        self.reaches(from, to) && self.links[from * self.robots + to].blocks == 0
    }

    /// Sends a message of `bytes` bytes: the times at which copies of it arrive.
    pub fn send(
        &mut self,
        now: Instant,
        from: usize,
        to: usize,
        bytes: usize,
        counts: &mut FaultCounts,
    ) -> Vec<Instant> {
        if !self.reaches(from, to) {
            counts.out_of_reach += 1;
            return Vec::new();
        }
        if !self.is_open(from, to) {
            counts.blocked += 1;
            return Vec::new();
        }
        let options = &self.options;
        let air = self.links[from * self.robots + to].air(self.seed, from, to);
        let Some(sent) = air.queue(now, bytes, options) else {
            counts.over_capacity += 1;
            return Vec::new();
        };
        let lost = air.dice.chance(options.loss);
        let burst = air.in_burst(now, options) && air.dice.chance(options.burst_loss);
        if lost || burst {
            *(if lost { &mut counts.lost } else { &mut counts.burst_lost }) += 1;
            return Vec::new();
        }
        let copies = if air.dice.chance(options.duplicate) { 2 } else { 1 };
        counts.duplicated += copies - 1;
        (0..copies).map(|_| sent.after(air.delay(options, counts))).collect()
    }
}

/// What else becomes of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tampering {
    /// A copy arrives that was changed; the number says how.
    Mangled(Instant, u64),
    /// It arrives once more.
    Replayed(Instant),
}

impl Network {
    /// Whether somebody tampers with a message that passed.
    pub fn tamper(&mut self, now: Instant, from: usize, to: usize) -> Option<Tampering> {
        let options = &self.options;
        if (options.mangle <= 0.0 && options.replay <= 0.0) || !self.is_open(from, to) {
            return None;
        }
        let dice = &mut self.links[from * self.robots + to].air(self.seed, from, to).dice;
        if dice.chance(options.mangle) {
            let at = now.after(millis(dice.range(1.0, 500.0)));
            return Some(Tampering::Mangled(at, dice.bits()));
        }
        dice.chance(options.replay).then(|| Tampering::Replayed(now.after(millis(dice.range(100.0, 60_000.0)))))
    }
}

impl Link {
    fn air(&mut self, seed: u64, from: usize, to: usize) -> &mut Air {
        let dice = || Dice::new(seed, &format!("link {from} {to}"));
        self.air
            .get_or_insert_with(|| Box::new(Air { dice: dice(), free_at: Instant::ZERO, burst: [Instant::ZERO; 2] }))
    }
}

impl Air {
    /// When the last byte has left; `None` if the queue is full.
    fn queue(&mut self, now: Instant, bytes: usize, options: &NetworkOptions) -> Option<Instant> {
        if options.bytes_per_sec <= 0.0 {
            return Some(now);
        }
        let start = self.free_at.max(now);
        if start.since(now) > millis(options.queue_ms_max) {
            return None;
        }
        self.free_at = start.after(millis(1e3 * (bytes + HEADER_BYTES) as f64 / options.bytes_per_sec));
        Some(self.free_at)
    }

    fn in_burst(&mut self, now: Instant, options: &NetworkOptions) -> bool {
        if options.bursts_per_min <= 0.0 {
            return false;
        }
        while self.burst[1] <= now {
            let begins = self.burst[1].after(millis(self.dice.exponential(60_000.0 / options.bursts_per_min)));
            self.burst = [begins, begins.after(millis(self.dice.exponential(options.burst_ms_mean).max(1.0)))];
        }
        self.burst[0] <= now
    }

    fn delay(&mut self, options: &NetworkOptions, counts: &mut FaultCounts) -> Duration {
        let mut ms = options.latency_ms_min + self.dice.exponential(options.latency_ms_mean - options.latency_ms_min);
        if self.dice.chance(options.reorder) {
            counts.reordered += 1;
            ms += self.dice.range(0.0, options.reorder_ms_max);
        }
        millis(ms)
    }
}

/// A duration of so many milliseconds; negative and NaN are zero.
pub fn millis(ms: f64) -> Duration {
    Duration::from_nanos((ms * 1e6) as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENT: u64 = 4000;

    /// Sends one message of 100 B each 10 ms and returns the arrivals.
    fn traffic(options: NetworkOptions, seed: u64) -> (Vec<Vec<Instant>>, FaultCounts) {
        let mut network = Network::new(options, 2, seed);
        let mut counts = FaultCounts::default();
        let at = |k: u64| Instant::from_nanos(k * 10_000_000);
        let arrivals = (0..SENT).map(|k| network.send(at(k), 0, 1, 100, &mut counts)).collect();
        (arrivals, counts)
    }

    fn near(count: u64, share: f64) -> bool {
        let n = SENT as f64;
        (count as f64 - n * share).abs() < 5.0 * (n * share * (1.0 - share)).sqrt()
    }

    #[test]
    fn a_clean_link_delivers_each_message_once_within_its_latency() {
        let (arrivals, counts) = traffic(NetworkOptions::default(), 1);
        assert_eq!(counts, FaultCounts::default());
        let mut sum = 0.0;
        for (k, times) in (0u64..).zip(&arrivals) {
            assert_eq!(times.len(), 1);
            let latency = times[0].since(Instant::from_nanos(k * 10_000_000));
            assert!(latency >= millis(1.0));
            sum += latency.as_secs_f64() * 1e3;
        }
        let mean = sum / SENT as f64;
        assert!((mean - 5.0).abs() < 0.4, "{mean}");
    }

    #[test]
    fn the_same_seed_gives_the_same_network() {
        let options = NetworkOptions {
            loss: 0.2,
            bursts_per_min: 20.0,
            duplicate: 0.2,
            reorder: 0.2,
            bytes_per_sec: 30_000.0,
            ..NetworkOptions::default()
        };
        assert_eq!(traffic(options.clone(), 5), traffic(options.clone(), 5));
        assert_ne!(traffic(options.clone(), 5).0, traffic(options, 6).0);
    }

    #[test]
    fn each_fault_fires_as_often_as_stated() {
        let (_, counts) = traffic(NetworkOptions { loss: 0.3, ..NetworkOptions::default() }, 2);
        assert!(near(counts.lost, 0.3), "{counts:?}");
        let (arrivals, counts) = traffic(NetworkOptions { duplicate: 0.5, ..NetworkOptions::default() }, 2);
        assert!(near(counts.duplicated, 0.5), "{counts:?}");
        assert_eq!(arrivals.iter().map(Vec::len).sum::<usize>() as u64, SENT + counts.duplicated);
        let (arrivals, counts) = traffic(NetworkOptions { reorder: 0.25, ..NetworkOptions::default() }, 2);
        assert!(near(counts.reordered, 0.25), "{counts:?}");
        assert!(arrivals.windows(2).any(|w| w[1][0] < w[0][0]), "nothing was overtaken");
    }

    #[test]
    fn losses_in_bursts_come_together() {
        let options =
            NetworkOptions { bursts_per_min: 30.0, burst_ms_mean: 500.0, burst_loss: 1.0, ..NetworkOptions::default() };
        let (arrivals, counts) = traffic(options, 3);
        // 20 bad spells of 0.5 s in 40 s, less what one takes from the other: a fifth of the time.
        assert!((400..1300).contains(&counts.burst_lost), "{counts:?}");
        let runs = arrivals.windows(2).filter(|w| !w[0].is_empty() && w[1].is_empty()).count() as u64;
        assert!(counts.burst_lost / runs.max(1) > 10, "{runs} spells");
    }

    #[test]
    fn a_cap_delays_then_drops() {
        // 160 B each 10 ms is 16 kB/s: half of it fits.
        let options = NetworkOptions { bytes_per_sec: 8000.0, queue_ms_max: 300.0, ..NetworkOptions::default() };
        let (arrivals, counts) = traffic(options, 4);
        assert!(near(counts.over_capacity, 0.5), "{counts:?}");
        let worst =
            (0u64..).zip(&arrivals).flat_map(|(k, t)| t.iter().map(move |t| t.since(at_10ms(k)))).max().unwrap();
        assert!((millis(300.0)..millis(450.0)).contains(&worst), "{worst:?}");
    }

    fn at_10ms(k: u64) -> Instant {
        Instant::from_nanos(k * 10_000_000)
    }

    #[test]
    fn blocks_are_counted_directed_and_healed() {
        let mut network = Network::new(NetworkOptions { loss: 1.0, ..NetworkOptions::default() }, 3, 1);
        let mut counts = FaultCounts::default();
        network.block(0, 1, true);
        network.block(0, 1, true);
        network.block(0, 1, false);
        assert!(!network.is_open(0, 1) && network.is_open(1, 0) && network.is_open(0, 2));
        assert!(!network.is_open(1, 1), "a robot is not its own neighbour");
        assert!(network.send(Instant::ZERO, 0, 1, 1, &mut counts).is_empty());
        assert_eq!(counts.blocked, 1);
        network.heal();
        assert_eq!(network.send(Instant::ZERO, 0, 1, 1, &mut counts).len(), 1, "healed of block and loss");
    }

    #[test]
    fn what_a_radio_does_not_reach_is_no_fault_and_stays_so_when_faults_heal() {
        let mut network = Network::new(NetworkOptions::default(), 3, 1);
        assert_eq!(network.in_reach(1), [0, 2]);
        network.set_reach(vec![vec![1], vec![0, 2], vec![1]]);
        network.heal();
        let mut counts = FaultCounts::default();
        assert!(network.is_open(0, 1) && !network.is_open(0, 2));
        assert!(network.send(Instant::ZERO, 0, 2, 1, &mut counts).is_empty());
        assert_eq!((counts.out_of_reach, counts.blocked), (1, 0));
        assert_eq!(network.in_reach(1), [0, 2]);
    }
}
