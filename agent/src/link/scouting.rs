//! Where Zenoh scouts. It reads this host's interfaces once per process (zenoh #1823): an agent that was started before
//! its radio had an address, or whose address changed, would look for peers where they are not, for ever and without a
//! word. So we look at the interfaces as well, with the library that Zenoh reads them with, and say so.

use crate::config::ZenohConfig;
use pnet_datalink::NetworkInterface;
use std::collections::BTreeSet;
use std::fmt;
use std::net::IpAddr;
use std::time::Duration;

/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// An interface and the address that Zenoh would scout from.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// Name of the interface.
    pub interface: String,
    /// Its first IPv4 address.
    pub address: IpAddr,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} on {}", self.address, self.interface)
    }
}

/// Where Zenoh scouts since it was started, and what became of it.
#[derive(Debug)]
pub struct Scouting {
    /// Interfaces or addresses to scout on, or `auto`.
    chosen: String,
    known: BTreeSet<Place>,
    /// Seen at the last look, and not known.
    fresh: BTreeSet<Place>,
}

impl Scouting {
    /// To be called before Zenoh opens; `None` if it does not scout.
    pub fn begin(config: &ZenohConfig) -> Option<Self> {
        config.multicast.then(|| {
            let chosen = config.interface.clone();
            let known = places(&chosen, &pnet_datalink::interfaces());
            Self { chosen, known, fresh: BTreeSet::new() }
        })
    }

    /// Completes when there is a place, at two looks in a row, that Zenoh does not know of. It is known from then on.
    pub async fn outgrown(&mut self) -> Place {
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            if let Some(place) = self.look(places(&self.chosen, &pnet_datalink::interfaces())) {
                return place;
            }
        }
    }

    /// An address that is just being changed is not there for long: what counts stays.
    fn look(&mut self, now: BTreeSet<Place>) -> Option<Place> {
        let fresh: BTreeSet<Place> = now.difference(&self.known).cloned().collect();
        let stays = fresh.intersection(&self.fresh).next().cloned();
        self.fresh = fresh;
        self.known.extend(stays.clone());
        stays
    }
}

/// Where Zenoh would scout if it read the interfaces now.
fn places(chosen: &str, interfaces: &[NetworkInterface]) -> BTreeSet<Place> {
    let is_chosen = |interface: &NetworkInterface| {
        chosen == "auto"
            || chosen
                .split(',')
                .map(str::trim)
                .any(|one| one == interface.name || interface.ips.iter().any(|network| one.parse() == Ok(network.ip())))
    };
    let able = interfaces.iter().filter(|one| one.is_up() && one.is_running() && one.is_multicast() && is_chosen(one));
    let place = |interface: &NetworkInterface| {
        let network = interface.ips.iter().find(|network| network.is_ipv4())?;
        Some(Place { interface: interface.name.clone(), address: network.ip() })
    };
    able.filter_map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the kernel flags them: up, broadcast, running, multicast.
    const ABLE: u32 = 0x1 | 0x2 | 0x40 | 0x1000;
    const LOOPBACK: u32 = 0x1 | 0x8 | 0x40;

    fn interface(name: &str, flags: u32, addresses: &[&str]) -> NetworkInterface {
        let ips = addresses.iter().map(|address| address.parse().unwrap()).collect();
        NetworkInterface { name: name.into(), description: String::new(), index: 1, mac: None, ips, flags }
    }

    fn at(interface: &str, address: &str) -> Place {
        Place { interface: interface.into(), address: address.parse().unwrap() }
    }

    #[test]
    fn zenoh_scouts_from_the_first_ipv4_address_of_what_is_up_and_chosen() {
        let all = [
            interface("lo", LOOPBACK, &["127.0.0.1/8"]),
            interface("radio", ABLE, &["fe80::1/64", "10.0.0.1/24", "10.0.0.9/24"]),
            interface("wired", ABLE, &["192.168.1.2/24"]),
            interface("down", ABLE & !1, &["10.1.0.1/24"]),
            interface("bare", ABLE, &["fe80::2/64"]),
        ];
        let [radio, wired] = [at("radio", "10.0.0.1"), at("wired", "192.168.1.2")];
        assert_eq!(places("auto", &all), BTreeSet::from([radio.clone(), wired.clone()]));
        assert_eq!(places("radio", &all), BTreeSet::from([radio.clone()]));
        assert_eq!(places("down, 192.168.1.2", &all), BTreeSet::from([wired]));
        assert_eq!(places("none", &all), BTreeSet::new());
        assert_eq!(radio.to_string(), "10.0.0.1 on radio");
    }

    #[test]
    fn a_place_is_told_once_when_it_stays_and_not_when_it_goes() {
        let [old, new] = [at("radio", "10.0.0.1"), at("radio", "10.0.0.2")];
        let mut scouting =
            Scouting { chosen: "auto".into(), known: BTreeSet::from([old.clone()]), fresh: BTreeSet::new() };
        let mut look = |places: &[&Place]| scouting.look(places.iter().map(|place| (*place).clone()).collect());
        assert_eq!(look(&[&old]), None);
        assert_eq!(look(&[]), None, "a radio that is off for a while is no news");
        assert_eq!(look(&[&old, &new]), None, "seen once");
        assert_eq!(look(&[&old]), None, "gone again");
        assert_eq!(look(&[&new]), None);
        assert_eq!(look(&[&new]), Some(new.clone()));
        assert_eq!(look(&[&new]), None, "told already");
    }

    #[test]
    fn who_does_not_scout_does_not_look() {
        let off = ZenohConfig { multicast: false, ..ZenohConfig::default() };
        assert!(Scouting::begin(&off).is_none());
        assert!(Scouting::begin(&ZenohConfig { multicast: true, ..off }).is_some());
    }
}
