//! What questions about small differences are worth while news keep coming. A neighbour that holds a fact more than we
//! do may only have heard it sooner: it is on its way to us, and who asks pays for a vector that brings nothing.
//! Whether it is so depends on the links, so each robot learns it from its own questions. Where messages are lost,
//! questions bring something and go on being asked; where none are, they become rare. A difference that stays when
//! nothing new comes any more is asked about at once, as is a large one.

use super::FAR_APART;
use crate::time::Instant;
use core::time::Duration;

/// News that are on their way have come after so long.
const ON_THEIR_WAY: Duration = Duration::from_millis(300);
/// What the last answer weighs against those before it.
const NOVELTY: f64 = 0.25;
/// No question is dearer than so many of those that bring something: a fact that was lost waits no longer for it.
const COPIES_MAX: f64 = 6.0;

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Experience {
    /// Share of questions that brought something.
    fruitful: f64,
    news: Option<Instant>,
}

impl Experience {
    /// Questions are taken to bring something.
    pub fn new() -> Self {
        Self { fruitful: 1.0, news: None }
    }

    /// Something new came, by whatever way.
    pub fn news(&mut self, now: Instant) {
        self.news = Some(now);
    }

    /// A question was answered.
    pub fn answered(&mut self, is_fruitful: bool) {
        self.fruitful += NOVELTY * (f64::from(u8::from(is_fruitful)) - self.fruitful);
    }

    /// How many times the usual a question costs that may bring so many facts.
    pub fn copies(&self, now: Instant, gain: f64) -> f64 {
        let is_flowing = self.news.is_some_and(|news| now < news.after(ON_THEIR_WAY));
        if is_flowing && gain < FAR_APART as f64 { (1.0 / self.fruitful).min(COPIES_MAX) } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn questions_that_bring_nothing_become_dear_until_one_does_or_news_cease() {
        let secs = |secs: f64| Instant::ZERO.after(Duration::from_secs_f64(secs));
        let mut experience = Experience::new();
        experience.news(secs(5.0));
        assert_eq!(experience.copies(secs(5.0), 1.0), 1.0, "nothing is known yet");
        let mut before = 1.0;
        for k in 0..20 {
            experience.answered(false);
            let copies = experience.copies(secs(5.0), 1.0);
            assert!(copies > before || copies == COPIES_MAX, "{k}: {copies}");
            before = copies;
        }
        assert_eq!(before, COPIES_MAX);
        assert_eq!(experience.copies(secs(5.0), FAR_APART as f64), 1.0, "much is worth it");
        assert!(experience.copies(secs(5.29), 1.0) > 1.0);
        assert_eq!(experience.copies(secs(5.3), 1.0), 1.0, "what is still different was lost");
        experience.answered(true);
        assert!(experience.copies(secs(5.0), 1.0) < 4.1);
    }
}
