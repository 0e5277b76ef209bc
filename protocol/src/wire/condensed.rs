//! Carried facts as bytes: each as the payload it would have as an entry of its own.

use super::fact::{CarriedFact, CondensedFact, Fact};
use super::limits::{self, CARRIED_MAX, PAYLOAD_LEN_MAX};
use super::payload::{FactError, KIND_CONDENSED};
use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawCondensed {
    #[serde(deserialize_with = "limits::list::<_, _, CARRIED_MAX>")]
    carried: Vec<RawCarried>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawCarried {
    /// Steps from the place before.
    step: u32,
    kind: u8,
    after: Option<u32>,
    #[serde(serialize_with = "limits::as_bytes", deserialize_with = "limits::bytes::<_, PAYLOAD_LEN_MAX>")]
    payload: Vec<u8>,
}

impl RawCondensed {
    pub fn of(fact: &CondensedFact) -> Result<Self, FactError> {
        check(&fact.carried)?;
        let mut last = 0;
        let mut carried = Vec::with_capacity(fact.carried.len());
        for one in &fact.carried {
            let step = one.seq.wrapping_sub(last); // places rise
            carried.push(RawCarried { step, kind: one.fact.kind(), after: one.after, payload: one.fact.to_payload()? });
            last = one.seq;
        }
        Ok(Self { carried })
    }

    pub fn parse(&self) -> Result<CondensedFact, FactError> {
        let mut last = 0u32;
        let mut carried = Vec::new(); // grows with what is sound, not with what is claimed
        for raw in &self.carried {
            let seq = last.checked_add(raw.step).ok_or_else(places)?;
            // Not even tried: a fact of facts of facts could ask for any depth of recursion.
            if raw.kind == KIND_CONDENSED {
                return Err(nested());
            }
            carried.push(CarriedFact { seq, after: raw.after, fact: Fact::from_payload(raw.kind, &raw.payload)? });
            last = seq;
        }
        check(&carried)?;
        Ok(CondensedFact { carried })
    }
}

fn check(carried: &[CarriedFact]) -> Result<(), FactError> {
    let rising = carried.is_sorted_by(|a, b| a.seq < b.seq);
    if carried.is_empty() || carried.len() > CARRIED_MAX || !rising {
        return Err(places());
    }
    for CarriedFact { after, fact, .. } in carried {
        match (after, fact) {
            (_, Fact::Condensed(_)) => return Err(nested()),
            (Some(after), Fact::Submap(submap)) if *after < submap.index => {}
            (None, _) => {}
            _ => return Err(FactError::Value { field: "after", mend: "must be a lower index, of a submap only" }),
        }
    }
    Ok(())
}

fn places() -> FactError {
    FactError::Value { field: "carried", mend: "must hold 1 to 120 facts, by rising places" }
}

fn nested() -> FactError {
    FactError::Value { field: "carried", mend: "must hold no condensed facts" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::fact::{RefusalReason, ScaleKind, VerdictFact, VerdictOutcome};
    use crate::wire::samples;

    fn verdict() -> Fact {
        let outcome = VerdictOutcome::Refused(RefusalReason::TooFew);
        let alignment = crate::ids::EntryId { frame: samples::frame(1, 4), seq: 9 };
        Fact::Verdict(VerdictFact { alignment, outcome })
    }

    fn carried(seq: u32, after: Option<u32>, fact: Fact) -> CarriedFact {
        CarriedFact { seq, after, fact }
    }

    fn payload(carried: Vec<CarriedFact>) -> Result<Vec<u8>, FactError> {
        Fact::Condensed(CondensedFact { carried }).to_payload()
    }

    #[test]
    fn what_is_carried_comes_back_with_its_place() {
        let submap = samples::submap_fact(ScaleKind::Metric); // index 7
        let all = vec![carried(0, None, submap.clone()), carried(3, None, verdict()), carried(90, Some(6), submap)];
        let bytes = payload(all).unwrap();
        let Fact::Condensed(read) = Fact::from_payload(KIND_CONDENSED, &bytes).unwrap() else { panic!() };
        let places: Vec<_> = read.carried.iter().map(|one| (one.seq, one.after, one.fact.kind())).collect();
        assert_eq!(places, [(0, None, 1), (3, None, 3), (90, Some(6), 1)]);
        assert_eq!(read.carried[1].fact, verdict());
    }

    #[test]
    fn what_cannot_be_carried_is_refused_on_both_sides() {
        let submap = || samples::submap_fact(ScaleKind::Metric);
        let nested = Fact::Condensed(CondensedFact { carried: vec![carried(0, None, verdict())] });
        assert!(payload(vec![]).is_err());
        assert!(payload(vec![carried(3, None, verdict()), carried(3, None, verdict())]).is_err());
        assert!(payload(vec![carried(3, Some(1), verdict())]).is_err(), "only submaps come after one");
        assert!(payload(vec![carried(3, Some(7), submap())]).is_err(), "never after itself");
        assert!(payload(vec![carried(3, None, nested)]).is_err());
        let many = |n: u32| payload((0..n).map(|seq| carried(seq, None, verdict())).collect());
        assert!(matches!(many(CARRIED_MAX as u32), Err(FactError::TooLong(_))), "full of verdicts it is long");
        let alike = |n: u32| {
            let fact = Fact::Lookalike(crate::wire::fact::LookalikeFact { i: 1, j: 9 });
            payload((0..n).map(|seq| carried(seq, None, fact.clone())).collect())
        };
        assert!(alike(CARRIED_MAX as u32).is_ok() && alike(CARRIED_MAX as u32 + 1).is_err());
        assert!(matches!(many(CARRIED_MAX as u32 + 1), Err(FactError::Value { .. })));
        // Bytes that claim a nested one, or places that wrap.
        let raw = |step, kind| RawCarried { step, kind, after: None, payload: verdict().to_payload().unwrap() };
        let read = |carried| RawCondensed { carried }.parse();
        assert!(read(vec![raw(5, 3), raw(1, 3)]).is_ok());
        assert!(read(vec![raw(5, 3), raw(0, 3)]).is_err());
        assert!(read(vec![raw(5, 3), raw(u32::MAX, 3)]).is_err());
        assert!(read(vec![raw(5, KIND_CONDENSED)]).is_err());
    }
}
