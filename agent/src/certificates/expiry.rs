//! How long a certificate is good for, and who is told when it ends. A robot whose certificate is over goes on by
//! itself, with links to nobody; one whose clock is behind, as after a start without a battery, waits until it is set.

use super::{Certificate, day};
use serde::Serialize;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Its end is warned of so many days ahead.
pub const WARN_DAYS: i64 = 30;
const SECS_PER_DAY: i64 = 86_400;
/// Time between two looks: a clock may be set meanwhile.
const LOOK_EVERY: Duration = Duration::from_secs(60);
/// Time between two warnings of one kind.
const TELL_EVERY: Duration = Duration::from_secs(86_400);

/// How a certificate stands at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Standing {
    /// Good for more than [`WARN_DAYS`].
    Valid,
    /// Good, and not for long.
    ExpiresSoon,
    /// Over: every other robot refuses it.
    Expired,
    /// Not good yet by this host's clock.
    NotYetValid,
}

/// What `view/status` says of the robot's certificate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CertificateView {
    /// Whom it names.
    pub name: String,
    /// Its last day, UTC.
    pub last_day: String,
    /// Whole days until it ends; negative when it is over.
    pub days_left: i64,
    /// How it stands.
    pub standing: Standing,
}

impl Certificate {
    /// How it stands at `now`, in seconds since 1970.
    pub fn standing(&self, now: i64) -> Standing {
        if now > self.not_after {
            Standing::Expired
        } else if now < self.not_before {
            Standing::NotYetValid
        } else if self.days_left(now) < WARN_DAYS {
            Standing::ExpiresSoon
        } else {
            Standing::Valid
        }
    }

    fn days_left(&self, now: i64) -> i64 {
        self.not_after.saturating_sub(now).div_euclid(SECS_PER_DAY)
    }

    /// What is said of it at `now`.
    pub fn view(&self, now: i64) -> CertificateView {
        let (name, last_day) = (self.holder.to_string(), self.last_day());
        CertificateView { name, last_day, days_left: self.days_left(now), standing: self.standing(now) }
    }

    /// What an operator is warned of, if there is reason to.
    pub fn warning(&self, now: i64) -> Option<String> {
        let last = self.last_day();
        match self.standing(now) {
            Standing::Valid => None,
            Standing::ExpiresSoon => Some(format!(
                "this robot's certificate expires on {last}, in {} days: no robot links with it from then on; make a new \
                 one by `merganser keys certificate` and start the agent again",
                self.days_left(now)
            )),
            Standing::Expired => Some(format!(
                "this robot's certificate expired on {last}: no robot links with it; make a new one by `merganser keys \
                 certificate` and start the agent again"
            )),
            Standing::NotYetValid => Some(format!(
                "by this host's clock it is {}, and this robot's certificate begins on {}: no link opens until the clock \
                 is set",
                day(now),
                day(self.not_before)
            )),
        }
    }
}

/// Seconds since 1970 by this host's clock.
pub fn now() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_secs()).unwrap_or(i64::MAX)
}

/// Warns at the start, whenever the standing changes, and daily.
pub async fn watch(certificate: Certificate) {
    let mut told: Option<(Standing, tokio::time::Instant)> = None;
    loop {
        let standing = certificate.standing(now());
        if told.is_none_or(|(before, when)| before != standing || when.elapsed() >= TELL_EVERY) {
            if let Some(warning) = certificate.warning(now()) {
                tracing::warn!("{warning}");
            }
            told = Some((standing, tokio::time::Instant::now()));
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
