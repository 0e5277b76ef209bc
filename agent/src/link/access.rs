//! Zenoh's access list: who may say what at the other end of a link. With plain links nobody is known, and the list
//! knows keys alone. With TLS a link's other end has a name, the common name of its certificate, and what a robot
//! publishes, answers and declares must stand under its own name.
//!
//! Zenoh knows the neighbour of a link and not the origin of a message. Peers do not relay, so among robots in mode
//! `peer` both are one. What a router relays comes in the router's name: there the router's own list tells robots apart,
//! which is this one, too. Robots in mode `router` relay for one another, so their lists tell members from others alone.

use crate::certificates::Holder;
use crate::certificates::credentials::Members;
use crate::keys;
use merganser_protocol::ids::Name;
use serde_json::{Value, json};

/// All messages but publications.
pub(super) fn asking() -> Value {
    json!([
        "query",
        "reply",
        "declare_subscriber",
        "declare_queryable",
        "liveliness_token",
        "liveliness_query",
        "declare_liveliness_subscriber"
    ])
}

/// Everything may be asked, declared and sent. What may come in as a publication is what [`keys`] knows; if input is
/// taken over `interfaces`, over these alone, and else from anyone, to be counted and refused. Zenoh looks at the
/// interface of the last link: a neighbour that runs on this host and relays for others is trusted with what it relays.
pub(super) fn of_anyone(interfaces: &[String]) -> Value {
    let inputs = interfaces.is_empty().then(|| "in/*".to_owned());
    let table = keys::CHANNELS.iter().map(|channel| keys::channel(*channel).to_string()).chain(["view/*".into()]);
    let heard: Vec<String> = table.chain(inputs).map(|rest| format!("{}/*/*/{rest}", keys::PREFIX)).collect();
    let mut list = List::default();
    let everything = ["**".to_owned()];
    let mut rules = vec![
        list.rule("ask and declare", asking(), BOTH, &everything),
        list.rule("send", publications(), OUT, &everything),
        list.rule("hear", publications(), IN, &heard),
    ];
    list.policy(json!({"id": "anyone"}), &rules);
    if !interfaces.is_empty() {
        rules = vec![list.rule("feed", publications(), IN, &everything)];
        list.policy(json!({"id": "these interfaces", "interfaces": interfaces}), &rules);
    }
    list.done()
}

/// The list of a robot or of a router of the swarm, by the names in certificates. `relays`: robots pass on what others
/// say. `feeding`: whose input comes in over which interfaces, too.
pub fn by_name(swarm: &Name, members: &Members, relays: bool, feeding: Option<(&Name, &[String])>) -> Value {
    let mut list = List::default();
    let all = |rests: &[String]| -> Vec<String> { rests.iter().map(|rest| keys::of_all(swarm, rest)).collect() };
    let [said, asked, views] = [channels(), questions(), vec!["view/*".into()]];
    let everything = [format!("{}/{swarm}/**", keys::PREFIX)];
    let alive = all(&[keys::ALIVE.into()]);

    // Whoever takes input over interfaces takes it by them alone: a robot would sign what another fed to it. Who takes
    // none lets it in, to be counted and refused in words.
    let astray = if feeding.is_none() { all(&["in/*".into()]) } else { Vec::new() };
    let published = [all(&[&said[..], &views].concat()), astray.clone()].concat();
    let relay = vec![
        list.rule("relay", asking(), BOTH, &everything),
        list.rule("pass on", publications(), OUT, &everything),
        list.rule("relay publications", publications(), IN, &published),
    ];
    if !members.routers.is_empty() {
        list.policy(named("all routers", members.routers.iter().cloned().map(Holder::Router)), &relay);
    }
    let robots = members.robots.iter().cloned().map(Holder::Robot);
    if relays && !members.robots.is_empty() {
        list.policy(named("all robots", robots), &relay);
    } else if !members.robots.is_empty() {
        let mut rules = vec![
            list.rule("ask", json!(["query"]), BOTH, &all(&asked)),
            list.rule("pass on questions for views", json!(["query"]), OUT, &all(&views)),
            list.rule("listen", json!(["declare_subscriber"]), IN, &all(&said)),
            list.rule("watch presence", presence(), BOTH, &alive),
            list.rule("tell", publications(), OUT, &all(&said)),
            list.rule("answer", json!(["reply"]), OUT, &all(&asked)),
            list.rule("declare", json!(["declare_subscriber", "declare_queryable"]), OUT, &everything),
            list.rule("show presence", json!(["liveliness_token"]), OUT, &alive),
        ];
        if !astray.is_empty() {
            rules.push(list.rule("send input astray", publications(), IN, &astray));
        }
        list.policy(named("all robots", robots), &rules);
        for robot in &members.robots {
            let of = |rests: &[String]| rests.iter().map(|rest| keys::of(swarm, robot, rest)).collect::<Vec<_>>();
            let rules = [
                list.rule(&format!("{robot} speaks"), publications(), IN, &of(&[&said[..], &views].concat())),
                list.rule(
                    &format!("{robot} answers"),
                    json!(["reply", "declare_queryable"]),
                    IN,
                    &of(&[&asked[..], &views].concat()),
                ),
                list.rule(&format!("{robot} is there"), json!(["liveliness_token"]), IN, &of(&[keys::ALIVE.into()])),
                list.rule(&format!("{robot} has input"), json!(["declare_subscriber"]), IN, &of(&["in/*".into()])),
            ];
            list.policy(named(&format!("robot {robot}"), [Holder::Robot(robot.clone())]), &rules);
        }
    }
    if !members.observers.is_empty() {
        let rules = [
            list.rule("ask for views", json!(["query"]), IN, &all(&views)),
            list.rule("subscribe to views", json!(["declare_subscriber"]), IN, &everything),
            list.rule("see presence", presence(), IN, &alive),
            list.rule("show views", json!(["put", "delete", "reply", "declare_queryable"]), OUT, &all(&views)),
            list.rule("show who is there", json!(["liveliness_token"]), OUT, &alive),
        ];
        list.policy(named("all observers", members.observers.iter().cloned().map(Holder::Observer)), &rules);
    }
    if let Some((robot, interfaces)) = feeding {
        let rules = [list.rule("feed", publications(), IN, &[keys::of(swarm, robot, "in/*")])];
        list.policy(json!({"id": "these interfaces", "interfaces": interfaces}), &rules);
    }
    list.done()
}

/// The list of somebody who only looks on: hears robots and routers of the swarm, and says nothing but questions.
pub(super) fn of_onlooker(swarm: &Name, members: &Members) -> Value {
    let mut list = List::default();
    let everything = [format!("{}/{swarm}/**", keys::PREFIX)];
    let rules =
        [list.rule("ask and declare", asking(), BOTH, &everything), list.rule("hear", publications(), IN, &everything)];
    let robots = members.robots.iter().cloned().map(Holder::Robot);
    let routers = members.routers.iter().cloned().map(Holder::Router);
    list.policy(named("robots and routers", robots.chain(routers)), &rules);
    list.done()
}

const IN: &[&str] = &["ingress"];
const OUT: &[&str] = &["egress"];
const BOTH: &[&str] = &["ingress", "egress"];

fn publications() -> Value {
    json!(["put", "delete"])
}

fn presence() -> Value {
    json!(["declare_liveliness_subscriber", "liveliness_query"])
}

fn channels() -> Vec<String> {
    keys::CHANNELS.iter().map(|channel| keys::channel(*channel).to_owned()).collect()
}

fn questions() -> Vec<String> {
    keys::QUERIES.iter().map(|kind| keys::query(*kind).to_owned()).collect()
}

fn named(id: &str, holders: impl IntoIterator<Item = Holder>) -> Value {
    let names: Vec<String> = holders.into_iter().map(|holder| holder.to_string()).collect();
    json!({"id": id, "cert_common_names": names})
}

/// Zenoh's three tables.
#[derive(Default)]
struct List {
    rules: Vec<Value>,
    subjects: Vec<Value>,
    policies: Vec<Value>,
}

impl List {
    /// Adds a rule, and gives its name.
    fn rule(&mut self, id: &str, messages: Value, flows: &[&str], keys: &[String]) -> String {
        self.rules
            .push(json!({"id": id, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": keys}));
        id.to_owned()
    }

    fn policy(&mut self, subject: Value, rules: &[String]) {
        self.policies.push(json!({"rules": rules, "subjects": [subject["id"]]}));
        self.subjects.push(subject);
    }

    fn done(self) -> Value {
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": self.rules,
            "subjects": self.subjects,
            "policies": self.policies,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A robot would sign what another fed to it, also through one that relays. Where input is taken over interfaces, it
    /// comes in by them alone; where none is, it comes in to be refused in words.
    #[test]
    fn input_comes_by_the_own_interfaces_alone_or_is_refused_in_words() {
        let name = |text: &str| Name::new(text).unwrap();
        let members = Members {
            robots: [name("alpha"), name("beta")].into(),
            routers: [name("hub")].into(),
            observers: [name("lena")].into(),
        };
        let doors = ["lo".to_owned()];
        for relays in [false, true] {
            let feeds = |rule: &&Value| {
                let has = |field: &str, what: &str| rule[field].as_array().unwrap().iter().any(|x| x == what);
                let covers = |key: &Value| {
                    let pattern = key.as_str().unwrap();
                    pattern.ends_with("/**") || pattern.contains("/in/")
                };
                has("messages", "put")
                    && has("flows", "ingress")
                    && rule["key_exprs"].as_array().unwrap().iter().any(covers)
            };
            let by = |feeding: Option<(&Name, &[String])>| -> Vec<Value> {
                let list = by_name(&name("field"), &members, relays, feeding);
                list["rules"].as_array().unwrap().iter().filter(feeds).map(|rule| rule["id"].clone()).collect()
            };
            assert_eq!(by(Some((&name("alpha"), &doors))), ["feed"], "relays: {relays}");
            let told =
                if relays { vec!["relay publications"] } else { vec!["relay publications", "send input astray"] };
            assert_eq!(by(None), told);
        }
    }
}
