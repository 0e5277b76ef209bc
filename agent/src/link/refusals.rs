//! Links that fail by their certificates. Zenoh says so in its log alone, at each try, on the one side without the
//! other's address and with a hint about open files, on the other side for developers. This layer of the log keeps each
//! reason, so that the agent tells it once, with the cure, and counts the rest.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::sync::{Arc, Mutex, PoisonError};
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::filter::{FilterFn, Filtered, filter_fn};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

/// Where Zenoh tells of links that it is asked for, and of those that it asks for.
const ACCEPTS: &str = "zenoh_link_tls";
const CONNECTS: &str = "zenoh::net::runtime::orchestrator";
/// What Zenoh warns of at each link, since we told it not to compare names to addresses.
const NO_NEWS: &str = "Skipping name verification";
/// So a line says that an endpoint of our own configuration is meant. Others come by multicast, which anybody may send:
/// their names would fill the table of reasons.
const CONFIGURED: &str = "configured peer";
const FOUND: &str = "a peer that was found by multicast";
/// Reasons kept apart until they are taken.
const REASONS_MAX: usize = 32;
/// Longest reason kept, in characters.
const REASON_CHARS_MAX: usize = 200;

/// Reasons since they were taken last, and how often each came.
#[derive(Debug, Default)]
pub struct Refusals(Mutex<BTreeMap<Refusal, u64>>);

/// Why a link failed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Refusal {
    /// Whom we called; `None` if somebody called us, of whom Zenoh does not say who.
    pub called: Option<String>,
    /// In the words of the TLS library.
    pub reason: String,
}

impl Refusal {
    /// Reads a line of Zenoh's; `None` if it is about something else.
    fn parse(target: &str, line: &str) -> Option<Self> {
        let short = |text: &str| text.chars().take(REASON_CHARS_MAX).collect::<String>();
        let begins = ["invalid peer certificate", "received fatal alert", "peer sent no certificates"];
        let at = match begins.iter().filter_map(|begin| line.find(begin)).min() {
            Some(at) => at,
            None if target.starts_with(ACCEPTS) && !line.starts_with(NO_NEWS) => 0,
            None => return None,
        };
        // What follows is another at each try, or Zenoh's: where in its source, when it tries again, a hint about files.
        let rest = &line[at..];
        let end = [": verification time", "., at ", " at /", ". Hint", ". Retry", ".)", "\n"]
            .iter()
            .filter_map(|end| rest.find(end))
            .min();
        let reason = short(rest[..end.unwrap_or(rest.len())].trim_end_matches(['.', ' ']));
        let called = (target == CONNECTS).then(|| {
            if !line.contains(CONFIGURED) {
                return FOUND.to_owned();
            }
            let begin = line.find("tls/").map_or("", |begin| &line[begin..]);
            short(begin.split(|c: char| c.is_whitespace() || "!,;?#".contains(c)).next().unwrap_or_default())
        });
        Some(Self { called: called.map(|text| text.trim_end_matches(':').to_owned()), reason })
    }

    /// What it means, and what helps.
    pub fn cure(&self) -> &'static str {
        let has = |part: &str| self.reason.contains(part);
        if has("not valid yet") {
            "one of the two hosts has a wrong clock"
        } else if has("expired") || has("Expired") {
            "the certificate is over (or a clock is wrong): renew it by `merganser keys certificate`"
        } else if has("UnknownIssuer") || has("UnknownCA") || has("BadSignature") || has("DecryptError") {
            "the certificate is of another swarm or another authority: make it with this swarm's"
        } else if has("no certificates") || has("CertificateRequired") {
            "somebody without a certificate called; robots get theirs by `merganser keys certificate`"
        } else if has("corrupt message") || has("eof") {
            "somebody called who does not speak TLS, or hung up: without zenoh.security = \"none\" there is no plain TCP, \
             and the robot's own SLAM connects to zenoh.input_listen (`view/status`: input)"
        } else if has("open files") {
            "let the agent have more files open: LimitNOFILE in its unit"
        } else {
            "look at both certificates; `merganser check` tells of one's own"
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.called {
            Some(endpoint) => write!(f, "refused: a link to {endpoint}: {}", self.reason),
            None => write!(f, "refused: a link from somebody: {}", self.reason),
        }
    }
}

impl Refusals {
    fn note(&self, refusal: Refusal) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let refusal = if kept.len() < REASONS_MAX || kept.contains_key(&refusal) {
            refusal
        } else {
            Refusal { called: None, reason: "other reasons".into() }
        };
        *kept.entry(refusal).or_default() += 1;
    }

    /// What came since the last call.
    pub fn take(&self) -> BTreeMap<Refusal, u64> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Whether an event is one that the agent tells in its own words.
pub(crate) fn is_told_otherwise(event: &Metadata<'_>) -> bool {
    event.target().starts_with(ACCEPTS) && *event.level() == Level::WARN
}

/// The layer that notes refusals.
pub fn layer<S>(into: Arc<Refusals>) -> Filtered<Noting, FilterFn, S>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let wanted = |event: &Metadata<'_>| is_told_otherwise(event) || event.target() == CONNECTS;
    Noting(into).with_filter(filter_fn(wanted))
}

/// See [`layer`].
#[derive(Debug)]
pub struct Noting(Arc<Refusals>);

impl<S: Subscriber> Layer<S> for Noting {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut message = Message(String::new());
        event.record(&mut message);
        if let Some(refusal) = Refusal::parse(event.metadata().target(), &message.0) {
            self.0.note(refusal);
        }
    }
}

struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}"); // a String takes any text
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zenohs_lines_are_read_whoever_called() {
        let accepts = "zenoh_link_tls::unicast";
        for (target, line, wanted) in [
            (
                accepts,
                "invalid peer certificate: UnknownIssuer. Hint: increase the system open file limit.",
                Some("refused: a link from somebody: invalid peer certificate: UnknownIssuer"),
            ),
            (
                accepts,
                "invalid peer certificate: certificate expired: verification time 1 (UNIX), but certificate is not valid \
                 after 0 (1 seconds ago). Hint: increase",
                Some("refused: a link from somebody: invalid peer certificate: certificate expired"),
            ),
            (
                CONNECTS,
                "Unable to connect to configured peer tls/10.0.0.2:7447! Can not create a new TLS link bound to \
                 IpAddress(V4(Ipv4Addr([10, 0, 0, 2]))): invalid peer certificate: BadSignature at \
                 /x/unicast.rs:1.. Retry in 1s.",
                Some("refused: a link to tls/10.0.0.2:7447: invalid peer certificate: BadSignature"),
            ),
            (
                CONNECTS,
                "Unable to connect any locator of scouted peer 1f: [tls/10.0.0.9:1]: invalid peer certificate: BadSignature",
                Some("refused: a link to a peer that was found by multicast: invalid peer certificate: BadSignature"),
            ),
            (CONNECTS, "Unable to connect to configured peer tls/10.0.0.2:7447! No route to host. Retry in 1s.", None),
            (
                accepts,
                "Too many open files (os error 24). Hint: increase the system open file limit.",
                Some("refused: a link from somebody: Too many open files (os error 24)"),
            ),
            (
                accepts,
                "received corrupt message of type InvalidContentType. Hint: increase",
                Some("refused: a link from somebody: received corrupt message of type InvalidContentType"),
            ),
            (accepts, "Skipping name verification of TLS server", None),
        ] {
            assert_eq!(Refusal::parse(target, line).map(|refusal| refusal.to_string()).as_deref(), wanted, "{line}");
        }
    }

    #[test]
    fn reasons_are_bounded() {
        let refusals = Refusals::default();
        let of = |k: usize| Refusal { called: Some(format!("tls/10.0.0.2:{k}")), reason: "x".into() };
        (0..REASONS_MAX + 5).for_each(|k| refusals.note(of(k)));
        let kept = refusals.take();
        assert_eq!((kept.len(), kept[&of(0)]), (REASONS_MAX + 1, 1));
        assert_eq!(kept[&Refusal { called: None, reason: "other reasons".into() }], 5);
        assert!(refusals.take().is_empty());
        let long = format!("invalid peer certificate: {}", "x".repeat(1_000));
        let kept = Refusal::parse(ACCEPTS, &long).unwrap().reason;
        assert_eq!(kept.chars().count(), REASON_CHARS_MAX);
    }
}
