//! The scenarios that come with the simulator can be read, and say what they are for.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use merganser_sim::scenario::Scenario;

#[test]
fn all_scenarios_are_good() {
    let folder = "scenarios";
    let mut count = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let scenario = Scenario::parse(&std::fs::read_to_string(&path).unwrap());
        let scenario = scenario.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert_eq!(path.file_stem().unwrap().to_str(), Some(scenario.name.as_str()));
        assert!(!scenario.about.is_empty());
        count += 1;
    }
    assert_eq!(count, 13);
}
