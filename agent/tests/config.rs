//! Bad configurations get one clear error each: the file, the line, the key, and what to mend.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use merganser::config::{FileConfig, FileConfigError, Security};
use merganser::trust::SecretKey;
use merganser_protocol::ids::Name;
use std::path::{Path, PathBuf};

const KEY: &str = "ea4a6c63e29c520abef5507b132ec5f9954776aebebe7b92421eea691446d22c"; // of the secret [7; 32]

const PLAIN: &str = "[zenoh]\nsecurity = \"none\"";
const CERTIFIED: &str = "[zenoh]\ncertificate = \"a.crt\"\nauthority = \"ca.crt\"";

fn text(robot: &str, key: &str, rest: &str) -> String {
    format!("swarm = \"demo\"\nrobot = \"{robot}\"\nkey_file = \"alpha.key\"\n[roster]\nalpha = \"{key}\"\n{rest}\n")
}

fn error(text: &str) -> String {
    FileConfig::parse(text, Path::new("a.toml")).unwrap_err().to_string()
}

#[test]
fn the_test_key_is_a_key() {
    assert_eq!(SecretKey::from_bytes([7; 32]).public().to_string(), KEY);
}

#[test]
fn the_least_configuration_is_enough() {
    let config = FileConfig::parse(&text("alpha", KEY, PLAIN), Path::new("a.toml")).unwrap();
    let name = Name::new("alpha").unwrap();
    let mut wanted = FileConfig::new(Name::new("demo").unwrap(), name.clone(), "alpha.key".into(), [].into());
    wanted.roster.insert(name, SecretKey::from_bytes([7; 32]).public());
    wanted.zenoh.security = Some(Security::None);
    wanted.zenoh.listen = vec!["tcp/[::]:0".into()];
    assert_eq!(config, wanted);
    let config = FileConfig::parse(&text("alpha", KEY, CERTIFIED), Path::new("a.toml")).unwrap();
    assert!(config.zenoh.is_guarded() && config.zenoh.listen == ["tls/0.0.0.0:0"]);
}

/// TLS, or nothing said plainly, for whoever has links beyond its host.
#[test]
fn links_beyond_this_host_are_protected_or_said_not_to_be() {
    let good = |lines: &str| FileConfig::parse(&text("alpha", KEY, lines), Path::new("a.toml")).unwrap();
    let alone = "[zenoh]\nmulticast = false\nlisten = [\"tcp/127.0.0.1:7\"]";
    assert!(!good(alone).zenoh.is_guarded());
    assert!(!good("[zenoh]\nmulticast = false\nmode = \"client\"\nconnect = [\"tcp/127.0.0.1:7\"]").zenoh.is_guarded());
    let tls = format!("{alone}\nsecurity = \"tls\"\ncertificate = \"a\"\nauthority = \"b\"").replace("tcp/", "tls/");
    assert!(good(&tls).zenoh.is_guarded() && !good(&tls).zenoh.stays_on_this_host());
    assert!(good(&tls.replace("security = \"tls\"\n", "")).zenoh.is_guarded(), "endpoints of TLS say so");
    let cases: &[(&str, &[&str])] = &[
        ("", &["a.toml", "zenoh.security", "zenoh.certificate", "zenoh.authority", "keys authority", "\"none\""]),
        ("[zenoh]\nlisten = [\"tcp/[::]:7\"]\nmulticast = false", &["zenoh.security", "beyond this host"]),
        (&format!("{alone}\nconnect = [\"tcp/10.0.0.2:7\"]"), &["zenoh.security", "beyond this host"]),
        (&alone.replace("false", "true"), &["zenoh.security", "beyond this host"]),
        ("[zenoh]\nsecurity = \"tls\"", &["zenoh.certificate", "is missing", "keys certificate"]),
        ("[zenoh]\nsecurity = \"tls\"\ncertificate = \"a\"", &["zenoh.authority", "is missing"]),
        (
            &format!("{CERTIFIED}\n\nlisten = [\"tcp/[::]:7\"]"),
            &["a.toml:10", "zenoh.listen", "plain TCP", "\"tls/…\""],
        ),
        (&format!("{PLAIN}\nconnect = [\"tls/10.0.0.2:7\"]"), &["a.toml:8", "zenoh.connect", "is TLS"]),
        (&format!("{PLAIN}\nlisten = [\"tls/[::]:7\"]"), &["a.toml:8", "zenoh.listen", "is TLS"]),
        (&format!("{CERTIFIED}\nlisten = [\"tls/[::]:7\"]"), &["a.toml:9", "zenoh.listen", "IPv6", "0.0.0.0"]),
        (&format!("{CERTIFIED}\nconnect = [\"tls/[fd00::1]:7\"]"), &["a.toml:9", "zenoh.connect", "IPv6"]),
        (&format!("{PLAIN}\nconnect = [\"udp/10.0.0.2:7\"]"), &["a.toml:8", "neither TLS nor TCP"]),
        (&format!("{CERTIFIED}\nconnect = [\"tls/10.0.0.2:7#enable_mtls=false\"]"), &["a.toml:9", "after '#'"]),
        (&format!("{CERTIFIED}\ninput_listen = [\"tls/127.0.0.1:7\"]"), &["a.toml:9", "is not TCP"]),
        ("[zenoh]\nsecurity = \"ssl\"", &["a.toml:7", "`ssl`", "`tls`"]),
        (&format!("{PLAIN}\n[observers]\nalpha = \"{KEY}\""), &["a.toml:9", "observers.alpha", "name of a robot"]),
        (&format!("{PLAIN}\n[observers]\nlaptop = \"{KEY}\""), &["a.toml:9", "observers.laptop", "same key as alpha"]),
    ];
    for (lines, wanted) in cases {
        let said = error(&text("alpha", KEY, lines));
        assert!(wanted.iter().all(|part| said.contains(part)), "{said}\nwanted {wanted:?} from\n{lines}");
        assert_eq!(said.lines().count(), 1, "{said}");
    }
}

#[test]
fn each_mistake_gets_one_error_that_names_its_line() {
    let cases: &[(String, &[&str])] = &[
        (text("alpha", KEY, "colour = 1"), &["a.toml:6", "expected a string"]), // [roster] takes any name
        (text("alpha", KEY, "[store]\ncolour = 1"), &["a.toml:7", "unknown field `colour`", "`path`"]),
        (format!("colour = 1\n{}", text("alpha", KEY, "")), &["a.toml:1", "unknown field `colour`", "`robot`"]),
        (text("Alpha", KEY, ""), &["a.toml:2", "\"Alpha\" is not a name"]),
        (text("beta", KEY, ""), &["a.toml:2", "robot", "\"beta\" is not in [roster]"]),
        (text("alpha", "zz", ""), &["a.toml:5", "'z' is no hexadecimal digit"]),
        (text("alpha", "00", ""), &["a.toml:5", "64 hexadecimal digits"]),
        (text("alpha", &"00".repeat(32), ""), &["a.toml:5", "no ed25519 public key"]),
        (text("alpha", KEY, &format!("beta = \"{KEY}\"")), &["a.toml:6", "roster.beta", "same key as alpha"]),
        (text("alpha", KEY, "Ä = \"00\""), &["a.toml:6"]),
        (text("alpha", KEY, "[zenoh]\nlease_secs = nan"), &["a.toml:7", "zenoh.lease_secs", "0.5 to 600 s"]),
        (text("alpha", KEY, "[zenoh]\ninput_bytes_max = 65535"), &["zenoh.input_bytes_max", "65536 to 16777216 bytes"]),
        (text("alpha", KEY, "[zenoh]\ninput_bytes_max = 16777217"), &["a.toml:7", "zenoh.input_bytes_max"]),
        (text("alpha", KEY, "[zenoh]\nconnect = [\"7447\"]"), &["a.toml:7", "zenoh.connect", "no endpoint"]),
        (text("alpha", KEY, "[zenoh]\ninput_listen = []"), &["a.toml:7", "zenoh.input_listen", "at least one"]),
        (text("alpha", KEY, "[zenoh]\ninput_listen = [\"7448\"]"), &["a.toml:7", "zenoh.input_listen", "no endpoint"]),
        (
            text("alpha", KEY, "[zenoh]\ninput_listen = [\"tcp/127.0.0.1:0\"]"),
            &["a.toml:7", "another port at each start"],
        ),
        (
            text("alpha", KEY, "[zenoh]\ninput_listen = [\"tcp/127.0.0.1:7448\", \"tcp/10.0.0.2:7448\"]"),
            &["a.toml:7", "tcp/10.0.0.2:7448", "zenoh.input_users_file"],
        ),
        (
            text("alpha", KEY, "[zenoh]\ninput_listen = [\"tcp/[::1]:1\"]\nlisten = [\"tcp/[::1]:1\"]"),
            &["a.toml:7", "is in zenoh.listen, too"],
        ),
        (text("alpha", KEY, "[debug]\nbytes_per_sec = 999"), &["a.toml:7", "debug.bytes_per_sec", "1000 to"]),
        (text("alpha", KEY, "[zenoh]\nmode = \"mesh\""), &["a.toml:7", "`mesh`", "`peer`"]),
        (
            text("alpha", KEY, "[core.submap]\n\nvoxel_m = -1"),
            &["a.toml:8", "core.submap.voxel_m", "-1", "0.001 to 10 m"],
        ),
        (text("alpha", KEY, "[driver]\nqueue = -3"), &["a.toml:7"]),
        (text("alpha", KEY, "[log]\nfilter = \"a=b=c\""), &["a.toml:7", "log.filter"]),
        ("swarm = ".into(), &["a.toml:1"]),
        ("swarm = \"demo\"".into(), &["a.toml", "missing field"]),
    ];
    for (text, wanted) in cases {
        let said = error(text);
        assert!(wanted.iter().all(|part| said.contains(part)), "{said}\nwanted {wanted:?} from\n{text}");
        assert_eq!(said.lines().count(), 1, "{said}");
    }
}

#[test]
fn the_bounds_of_input_are_within_them() {
    for bytes in [65_536, 16_777_216] {
        let config =
            FileConfig::parse(&text("alpha", KEY, &format!("{PLAIN}\ninput_bytes_max = {bytes}")), Path::new("a"));
        assert_eq!(config.unwrap().zenoh.input_bytes_max, bytes);
    }
}

/// Who may feed a robot by the session of the robots: this host, if that session never leaves it.
#[test]
fn a_swarm_on_one_host_takes_input_on_its_own_session_and_no_other_does() {
    let feeding = |lines: &str| {
        let config = FileConfig::parse(&text("alpha", KEY, &format!("{PLAIN}\n{lines}")), Path::new("a")).unwrap();
        config.zenoh.feeding_interfaces()
    };
    let nobody: [String; 0] = [];
    let alone = "multicast = false\nlisten = [\"tcp/127.0.0.1:7\", \"tcp/[::1]:7\", \"tcp/localhost:8\"]";
    assert_eq!(feeding(alone), ["lo", "lo0"]);
    assert_eq!(feeding(&format!("{alone}\nconnect = [\"tcp/127.0.0.2:7\"]")), ["lo", "lo0"]);
    assert_eq!(feeding(&format!("{alone}\nconnect = [\"tcp/10.0.0.2:7\"]")), nobody);
    assert_eq!(feeding(&format!("{alone}\ninput_listen = [\"tcp/127.0.0.1:9\"]")), nobody);
    assert_eq!(feeding(&alone.replace("false", "true")), nobody);
    assert_eq!(feeding("multicast = false\nlisten = [\"tcp/[::]:7\"]"), nobody);
    assert_eq!(feeding("multicast = false\nlisten = []"), nobody);
    assert_eq!(feeding("multicast = false\nmode = \"client\"\nconnect = [\"tcp/127.0.0.1:7\"]"), nobody);
    assert_eq!(feeding(""), nobody);
    assert_eq!(feeding("input_interfaces = [\"eth0\"]"), ["eth0"]);
    let users = "input_listen = [\"tcp/10.0.0.2:7448\"]\ninput_users_file = \"users\"";
    assert_eq!(feeding(users), nobody);
}

#[test]
fn what_is_saved_is_what_is_loaded_with_paths_relative_to_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = FileConfig::parse(&text("alpha", KEY, PLAIN), Path::new("a.toml")).unwrap();
    config.store.path = "/absolute/store.redb".into();
    config.core.submap.voxel_m = 0.25;
    config.save(&dir.path().join("a.toml")).unwrap();
    let loaded = FileConfig::load(&dir.path().join("a.toml")).unwrap();
    assert_eq!(loaded.key_file, dir.path().join("alpha.key"));
    assert_eq!(loaded.store.path, PathBuf::from("/absolute/store.redb"));
    assert_eq!(FileConfig { key_file: "alpha.key".into(), ..loaded }, config);
}

#[test]
fn the_key_file_must_exist_and_match_the_roster() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.toml");
    std::fs::write(&path, text("alpha", KEY, PLAIN)).unwrap();
    let config = FileConfig::load(&path).unwrap();
    assert!(matches!(config.identity(), Err(FileConfigError::Trust(_))));
    SecretKey::from_bytes([8; 32]).save(&config.key_file).unwrap();
    assert!(config.identity().err().unwrap().to_string().contains("[roster] has another for alpha"));
    std::fs::remove_file(&config.key_file).unwrap();
    SecretKey::from_bytes([7; 32]).save(&config.key_file).unwrap();
    assert_eq!(config.identity().unwrap().secret_key, [7; 32]);
}

#[test]
fn a_missing_or_huge_file_is_told_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.toml");
    assert!(FileConfig::load(&path).unwrap_err().to_string().contains("a.toml"));
    std::fs::write(&path, vec![b'#'; (1 << 20) + 1]).unwrap();
    assert!(FileConfig::load(&path).unwrap_err().to_string().contains("larger than"));
}
