//! What no gossip can beat where contacts come and go: robots in touch, directly or through others, share all they hold
//! at once, and nothing is lost. The distance to it is the gossip's; the rest is the world's.

use super::case::World;
use super::run::Outcome;
use crate::field::{Field, TICK};

/// The bound of one world; `None` where links do not change, for there it is nothing.
pub fn bound(world: &World, seed: u64) -> Option<Outcome> {
    let mut field = Field::new(world.layout, world.robots, seed);
    if !field.moves() {
        return None;
    }
    let mut held: Vec<Set> = (0..world.robots).map(|k| Set::of(k, world.robots)).collect();
    let mut now = 0.0;
    let mut equal_after = None;
    while equal_after.is_none() && now <= world.until {
        field.drive(now, TICK);
        share(&field, &mut held, now + 1e-6 < world.heal_at);
        if held.iter().all(|set| set.is_full(world.robots)) {
            equal_after = Some((now - world.heal_at).max(0.0));
        }
        now += TICK;
    }
    Some(Outcome::of_bound(world, seed, equal_after))
}

/// Every group of robots in touch comes to hold what any of them holds.
fn share(field: &Field, held: &mut [Set], cut: bool) {
    let mut group: Vec<usize> = (0..held.len()).collect();
    for a in 0..held.len() {
        for b in a + 1..held.len() {
            if field.linked(a, b, cut) {
                let (x, y) = (first(&mut group, a), first(&mut group, b));
                group[x.max(y)] = x.min(y);
            }
        }
    }
    for k in 0..held.len() {
        let to = first(&mut group, k);
        let set = held[k].clone();
        held[to].add(&set);
    }
    for k in 0..held.len() {
        let from = first(&mut group, k);
        held[k] = held[from].clone();
    }
}

/// The first of a robot's group.
fn first(group: &mut [usize], mut k: usize) -> usize {
    while group[k] != k {
        group[k] = group[group[k]];
        k = group[k];
    }
    k
}

/// Robots whose facts are held.
#[derive(Clone)]
struct Set(Vec<u64>);

impl Set {
    fn of(robot: usize, robots: usize) -> Self {
        let mut words = vec![0; robots.div_ceil(64)];
        words[robot / 64] = 1 << (robot % 64);
        Self(words)
    }

    fn add(&mut self, other: &Self) {
        self.0.iter_mut().zip(&other.0).for_each(|(a, b)| *a |= b);
    }

    fn is_full(&self, robots: usize) -> bool {
        self.0.iter().map(|word| word.count_ones() as usize).sum::<usize>() == robots
    }
}
