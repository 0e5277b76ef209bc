//! Clocks that go on, are set back, or err once.

use super::{Order, Turn};
use crate::limits::REORDER_NS_MAX;
use proptest::prelude::*;

fn turns(stamps: impl IntoIterator<Item = i64>) -> Vec<Turn> {
    let mut order = Order::default();
    stamps.into_iter().map(|stamp| order.take(stamp)).collect()
}

#[test]
fn a_clock_set_back_is_told_on_both_sides_of_the_limit_until_it_is_where_it_was() {
    let at = 10 * REORDER_NS_MAX;
    assert_eq!(turns([at, at - REORDER_NS_MAX]), [Turn::On; 2]);
    let back = turns([at, at - REORDER_NS_MAX - 1, at - 1, at, at + 1, at]);
    assert_eq!(back, [Turn::On, Turn::Back, Turn::Back, Turn::Back, Turn::On, Turn::On]);
}

#[test]
fn one_stamp_far_ahead_is_left_out_alone() {
    let at = 10 * REORDER_NS_MAX;
    let ahead = turns([at, 5 * at, at + 1, at + 2]);
    assert_eq!(ahead, [Turn::On, Turn::On, Turn::Alone(at), Turn::On]);
    // Two in a row are a clock that was set ahead, and then back.
    assert_eq!(turns([at, 5 * at, 5 * at + 1, at + 1])[3], Turn::Back);
}

proptest! {
    /// Stamps that rise with so little disorder are all taken.
    #[test]
    fn little_disorder_is_none(steps in prop::collection::vec((0..5 * REORDER_NS_MAX, 0..=REORDER_NS_MAX / 2), 1..50)) {
        let mut at = 0;
        let stamps = steps.iter().map(|(step, late)| { at += step; at - late });
        prop_assert!(turns(stamps).iter().all(|turn| *turn == Turn::On));
    }
}
