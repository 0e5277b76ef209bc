//! The bytes of version 1, frozen. Every message and every fact (as a signed entry) has a file in `golden/v1` and a
//! JSON snapshot of what it means. `MERGANSER_GOLDEN_WRITE=1` writes the files of new samples and never touches old
//! ones: bytes that changed are a new version.

use super::samples;
use super::{Entry, EntryBytes, Message};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::PathBuf;

fn folder() -> PathBuf {
    PathBuf::from("golden/v1")
}

fn check(name: &str, bytes: &[u8], meaning: &impl serde::Serialize) {
    let text = serde_json::to_string_pretty(meaning).unwrap() + "\n";
    let (bin, json) = (folder().join(format!("{name}.bin")), folder().join(format!("{name}.json")));
    if std::env::var_os("MERGANSER_GOLDEN_WRITE").is_some() && !bin.exists() && !json.exists() {
        std::fs::write(&bin, bytes).unwrap();
        std::fs::write(&json, &text).unwrap();
    }
    let read = |path: &PathBuf| {
        std::fs::read(path)
            .unwrap_or_else(|e| panic!("{}: {e}; for a new sample set MERGANSER_GOLDEN_WRITE=1", path.display()))
    };
    assert_eq!(read(&bin), bytes, "{name}.bin: version 1 has changed");
    // Compared as values: key order and number formatting are the JSON library's business.
    let (old, new): (Value, Value) =
        (serde_json::from_slice(&read(&json)).unwrap(), serde_json::from_str(&text).unwrap());
    assert_eq!(old, new, "{name}.json: the same bytes mean something else");
}

#[test]
fn version_1_is_frozen() {
    let mut names = BTreeSet::new();
    for (name, message) in samples::messages() {
        let name = format!("message_{name}");
        let bytes = message.encode();
        assert_eq!(Message::decode(&bytes).unwrap(), message, "{name}");
        check(&name, &bytes, &message);
        assert!(names.insert(name));
    }
    for (name, fact) in samples::facts() {
        let name = format!("entry_{name}");
        let entry = samples::entry_of(0, 3, &fact);
        let bytes = entry.encode();
        assert_eq!(Entry::decode(&bytes).unwrap(), entry, "{name}");
        check(&name, &bytes, &EntryBytes(bytes.clone()));
        assert!(names.insert(name));
    }
    let files = std::fs::read_dir(folder()).unwrap().map(|file| file.unwrap().path());
    let stray: Vec<_> = files.filter(|path| !names.contains(path.file_stem().unwrap().to_str().unwrap())).collect();
    assert!(stray.is_empty(), "golden files without a sample: {stray:?}");
}
