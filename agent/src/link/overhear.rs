//! What a robot's own SLAM sends, listened to where its agent would: for whoever wants to look at it before the agent runs.

use super::door::Door;
use super::hear::parse;
use super::refused;
use super::session::{self, LinkError, Role};
use crate::config::FileConfig;
use crate::keys;
use merganser_protocol::agent::io::Input;
use merganser_protocol::submap::Keyframe;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use zenoh::sample::Sample;

/// Keyframes that are kept at most, and their points.
const KEYFRAMES_MAX: usize = 4_096;
const POINTS_MAX: usize = 20_000_000;
/// Reasons that are told apart.
const REASONS_MAX: usize = 16;
/// How long a session may take to close.
const CLOSE_WAIT: Duration = Duration::from_secs(2);

/// What came.
#[derive(Debug, Default)]
pub struct Overheard {
    /// Keyframes, and when each came.
    pub keyframes: Vec<(Instant, Keyframe)>,
    /// Why other messages could not be read, and how many.
    pub refused: BTreeMap<String, u64>,
    points: usize,
}

impl Overheard {
    fn take(&mut self, read: Result<Input, String>) {
        match read {
            Ok(Input::Keyframe(keyframe)) => {
                let points = self.points + keyframe.points.len();
                if self.keyframes.len() < KEYFRAMES_MAX && points <= POINTS_MAX {
                    self.points = points;
                    self.keyframes.push((Instant::now(), keyframe));
                } else {
                    self.refuse(format!(
                        "more than {KEYFRAMES_MAX} keyframes or {POINTS_MAX} points are not kept; listen for fewer seconds"
                    ));
                }
            }
            Ok(_) => {}
            Err(reason) => self.refuse(reason),
        }
    }

    fn refuse(&mut self, reason: String) {
        let is_known = self.refused.len() < REASONS_MAX || self.refused.contains_key(&reason);
        let reason = if is_known { reason } else { "for other reasons".into() };
        *self.refused.entry(reason).or_default() += 1;
    }
}

/// Listens for so long; `told` learns where.
///
/// # Errors
/// [`LinkError`] if the agent, or another program, has the endpoint.
pub async fn overhear(
    config: &FileConfig,
    duration: Duration,
    told: impl FnOnce(&[String]),
) -> Result<Overheard, LinkError> {
    let door = Door::open(config).await?;
    let session = match &door.session {
        Some(session) => session.clone(),
        None => session::open(&config.zenoh, Role::Robot).await?,
    };
    let heard = Arc::new(Mutex::new(Overheard::default()));
    let key = keys::of(&config.swarm, &config.robot, "in/keyframe");
    let (into, limit) = (heard.clone(), config.zenoh.input_bytes_max);
    let hear = move |sample: Sample| {
        let read = parse("keyframe", &sample, limit).map_err(|unfit| unfit.reason);
        into.lock().unwrap_or_else(PoisonError::into_inner).take(read);
    };
    session.declare_subscriber(key.clone()).callback(hear).background().await.map_err(refused(key))?;
    told(&door.endpoints);
    tokio::time::sleep(duration).await;
    session::close(&session, CLOSE_WAIT).await;
    let mut heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(core::mem::take(&mut *heard))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observation::{self, Format};

    #[test]
    fn so_many_reasons_are_told_apart_and_the_rest_is_counted_together() {
        let mut heard = Overheard::default();
        (0..2 * REASONS_MAX).for_each(|k| heard.take(Err(k.to_string())));
        heard.take(Err("0".into()));
        assert_eq!(heard.refused.len(), REASONS_MAX + 1);
        assert_eq!((heard.refused["0"], heard.refused["for other reasons"]), (2, REASONS_MAX as u64));
    }

    #[test]
    fn so_many_keyframes_and_points_are_kept_and_the_rest_is_counted() {
        let seen = |points: usize| {
            let keyframe = serde_json::json!({"stamp_ns": 1, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1],
                "covariance": (0..6).flat_map(|r| (r..6).map(move |c| f64::from(u8::from(r == c)))).collect::<Vec<_>>(),
                "points": vec![[1.0, 2.0, 3.0]; points]});
            let keyframe = observation::keyframe(Format::Json, keyframe.to_string().as_bytes());
            keyframe.map(Input::Keyframe).map_err(|error| error.to_string())
        };
        let mut heard = Overheard::default();
        (0..KEYFRAMES_MAX).for_each(|_| heard.take(seen(0)));
        assert_eq!((heard.keyframes.len(), heard.refused.len()), (KEYFRAMES_MAX, 0));
        heard.take(seen(0));
        assert_eq!((heard.keyframes.len(), heard.refused.values().sum::<u64>()), (KEYFRAMES_MAX, 1));
        let mut heard = Overheard { points: POINTS_MAX - 10, ..Overheard::default() };
        heard.take(seen(11));
        assert_eq!((heard.keyframes.len(), heard.refused.values().sum::<u64>()), (0, 1));
        heard.take(seen(10));
        assert_eq!((heard.keyframes.len(), heard.points), (1, POINTS_MAX), "one too many keeps no smaller one out");
    }
}
