use super::authority::{Authority, DAYS, Files, key_pem, write_over};
use super::credentials::{self, Credentials, Members};
use super::expiry::{Standing, WARN_DAYS, now};
use super::router::Router;
use super::*;
use crate::trust::SecretKey;
use proptest::prelude::*;
use std::os::unix::fs::PermissionsExt;
use time::{Duration, OffsetDateTime};

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn robot(text: &str) -> Holder {
    Holder::Robot(name(text))
}

fn key(byte: u8) -> SecretKey {
    SecretKey::from_bytes([byte; 32])
}

#[test]
fn a_certificate_carries_the_name_and_the_key_of_the_roster() {
    let authority = Authority::generate(name("demo"), 10).unwrap();
    for holder in [robot("alpha"), Holder::Observer(name("laptop")), Holder::Router(name("hub"))] {
        let made = authority.issue(&holder, &key(7).public(), DAYS).unwrap();
        let read = Certificate::parse(format!("a line before\n{}and after\n", made.pem()).as_bytes()).unwrap();
        assert_eq!((&read, &read.holder, read.key), (&made, &holder, key(7).public()));
        assert!(read.is_signed_by(authority.certificate()) && !read.is_authority);
        assert!(!read.is_signed_by(&read), "it may sign nothing");
        assert_eq!(Holder::parse(&holder.to_string()), Some(holder));
    }
    let other = Authority::generate(name("demo"), 10).unwrap();
    let made = authority.issue(&robot("alpha"), &key(7).public(), DAYS).unwrap();
    assert!(!made.is_signed_by(other.certificate()), "of the same name, with another key");
    let again = authority.issue(&robot("alpha"), &key(7).public(), DAYS).unwrap();
    assert_ne!(made.der, again.der, "serial numbers differ");
}

#[test]
fn names_with_a_colon_are_no_robots() {
    assert_eq!(Holder::parse("observer:alpha"), Some(Holder::Observer(name("alpha"))));
    for bad in ["", "Alpha", "observer:", "robot:alpha", "example.com", "alpha beta"] {
        assert_eq!(Holder::parse(bad), None, "{bad}");
    }
}

#[test]
fn secret_files_are_for_their_owner_alone_and_nothing_is_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    let files = Files::of(&name("demo"), dir.path());
    let authority = Authority::generate(name("demo"), 10).unwrap();
    authority.save(&files).unwrap();
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&files.key), 0o600);
    let loaded = Authority::load(&Files::of_key(&files.key)).unwrap();
    assert_eq!((loaded.swarm(), loaded.certificate()), (&name("demo"), authority.certificate()));
    assert!(matches!(authority.save(&files).unwrap_err().problem, Problem::Exists));
    std::fs::set_permissions(&files.key, std::fs::Permissions::from_mode(0o640)).unwrap();
    let told = Authority::load(&files).unwrap_err().to_string();
    assert!(told.contains("demo.authority.key") && told.contains("chmod 600"), "{told}");

    let made = authority.issue(&robot("alpha"), &key(7).public(), DAYS).unwrap();
    let path = dir.path().join("alpha.crt");
    for _ in 0..2 {
        write_over(&path, made.pem()).unwrap(); // certificates are renewed
        assert_eq!(Certificate::load(&path).unwrap(), made);
    }
}

#[test]
fn an_authority_whose_files_do_not_belong_together_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let [mine, other] = ["mine", "other"].map(|swarm| {
        let files = Files::of(&name(swarm), dir.path());
        Authority::generate(name(swarm), 10).unwrap().save(&files).unwrap();
        files
    });
    let mixed = Files { certificate: other.certificate, key: mine.key.clone() };
    let told = Authority::load(&mixed).unwrap_err().to_string();
    assert!(told.contains("other.authority.crt") && told.contains("carries the key"), "{told}");
    std::fs::write(&mine.key, "no key").unwrap();
    let told = Authority::load(&mine).unwrap_err().to_string();
    assert!(told.contains("mine.authority.key") && told.contains("no ed25519 key in PEM"), "{told}");
}

#[test]
fn files_are_bounded_on_both_sides() {
    let dir = tempfile::tempdir().unwrap();
    let authority = Authority::generate(name("demo"), 10).unwrap();
    let path = dir.path().join("a.crt");
    let filled = |bytes: u64| {
        let pem = authority.certificate().pem().as_bytes();
        let mut content = pem.to_vec();
        content.resize(bytes as usize, b'\n');
        std::fs::write(&path, content).unwrap();
        Certificate::load(&path)
    };
    assert!(filled(FILE_LEN_MAX).is_ok());
    let told = filled(FILE_LEN_MAX + 1).unwrap_err().to_string();
    assert!(told.contains("a.crt") && told.contains("larger than 16384 bytes"), "{told}");
}

/// What of a robot's own files does not fit is one error each, with file and cure.
#[test]
fn credentials_that_do_not_fit_are_told_by_file() {
    let dir = tempfile::tempdir().unwrap();
    let [demo, old, other] = [("demo", "a.crt"), ("demo", "old.crt"), ("other", "other.crt")].map(|(swarm, file)| {
        let authority = Authority::generate(name(swarm), 10).unwrap();
        write_over(&dir.path().join(file), authority.certificate().pem()).unwrap();
        authority
    });
    let issue = |authority: &Authority, holder: &Holder, byte: u8| {
        write_over(&dir.path().join("alpha.crt"), authority.issue(holder, &key(byte).public(), 1).unwrap().pem())
            .unwrap();
    };
    let load = |authority: &str| {
        let (certificate, authority) = (dir.path().join("alpha.crt"), dir.path().join(authority));
        let files = credentials::Files { certificate: &certificate, authority: &authority };
        Credentials::load(files, &name("demo"), &robot("alpha"), &key(7))
    };
    let told = |authority: &str, parts: &[&str]| {
        let told = load(authority).unwrap_err().to_string();
        assert!(parts.iter().all(|part| told.contains(part)), "{told}\nwanted {parts:?}");
        assert_eq!(told.lines().count(), 1);
    };
    issue(&demo, &robot("alpha"), 7);
    let good = load("a.crt").unwrap();
    assert_eq!(good.certificate.key, key(7).public());
    assert!(good.key_pem().contains("PRIVATE KEY") && !format!("{good:?}").contains("PRIVATE"));
    told("other.crt", &["other.crt", "swarm:other", "swarm:demo"]);
    told("alpha.crt", &["alpha.crt", "no authority"]);
    told("none.crt", &["none.crt", "No such file"]);
    issue(&demo, &robot("alpha"), 8);
    told("a.crt", &["alpha.crt", "carries the key", "the one of alpha", "keys certificate"]);
    issue(&demo, &robot("beta"), 7);
    told("a.crt", &["alpha.crt", "certificate of beta", "the one of alpha"]);
    for stranger in [&old, &other] {
        issue(stranger, &robot("alpha"), 7);
        told("a.crt", &["alpha.crt", "not signed by the authority", "a.crt", "keys certificate"]);
    }
    std::fs::write(dir.path().join("alpha.crt"), key_pem(&[7; 32])).unwrap();
    told("a.crt", &["alpha.crt", "private key", ".crt file"]);
}

#[test]
fn the_end_of_a_certificate_is_warned_of_from_thirty_days_ahead() {
    let authority = Authority::generate(name("demo"), 10).unwrap();
    let made = |days| authority.issue(&robot("alpha"), &key(7).public(), days).unwrap();
    let certificate = made(WARN_DAYS as u32);
    assert_eq!(certificate.standing(now() - 2), Standing::Valid, "a moment more than thirty days");
    assert_eq!(certificate.standing(now() + 2), Standing::ExpiresSoon);
    assert_eq!(certificate.standing(certificate.not_after), Standing::ExpiresSoon, "the last second");
    assert_eq!(certificate.standing(certificate.not_after + 1), Standing::Expired);
    assert_eq!(certificate.standing(certificate.not_before), Standing::Valid);
    assert_eq!(certificate.standing(certificate.not_before - 1), Standing::NotYetValid);
    assert_eq!(certificate.warning(now() - 2), None);
    let told = certificate.warning(now() + 2).unwrap();
    assert!(told.contains("in 29 days") && told.contains("keys certificate"), "{told}");
    let view = certificate.view(certificate.not_after + 1);
    assert_eq!((view.days_left, view.standing), (-1, Standing::Expired));
    assert!(certificate.warning(0).unwrap().contains("by this host's clock it is 1970-01-01"));
    let past = OffsetDateTime::now_utc() - Duration::days(10);
    let past = authority.issue_at(&robot("alpha"), &key(7).public(), past, 5).unwrap();
    assert_eq!(past.standing(now()), Standing::Expired);
}

#[test]
fn zenoh_takes_a_routers_file_and_its_list_names_everybody() {
    let authority = Authority::generate(name("demo"), 10).unwrap();
    let members = Members {
        robots: [name("alpha"), name("robots")].into(),
        observers: [name("laptop")].into(),
        routers: [name("hub"), name("other")].into(),
    };
    let listen = vec!["tls/127.0.0.1:0".to_owned()];
    let router = Router { name: name("hub"), listen, connect: Vec::new(), lease_secs: 10.0 };
    let (text, certificate) = router.configuration(&authority, &members, 5).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("hub.json5");
    std::fs::write(&path, &text).unwrap();
    let config = zenoh::Config::from_file(&path).unwrap();
    let list = config.get_json("access_control").unwrap();
    for subject in ["alpha", "robots", "observer:laptop", "router:hub", "router:other"] {
        assert!(list.contains(&format!("\"{subject}\"")), "{subject} in {list}");
    }
    assert_eq!(config.get_json("transport/link/tls/enable_mtls").unwrap(), "true");
    assert_eq!(certificate.holder, Holder::Router(name("hub")));
    assert!(text.lines().take(2).all(|line| line.starts_with("// ")));
}

/// A certificate has one form: no byte can be another one, also of those that the signature does not cover.
#[test]
fn no_byte_of_a_certificate_can_be_another() {
    let authority = Authority::generate(name("demo"), 10).unwrap();
    let made = authority.issue(&robot("alpha"), &key(7).public(), DAYS).unwrap();
    assert!(made.is_signed_by(authority.certificate()));
    for at in 0..made.der.len() {
        for flip in [1, 4, 64, 128, 255] {
            let mut der = made.der.clone();
            der[at] ^= flip;
            if let Ok(read) = Certificate::parse(pem("CERTIFICATE", &der).as_bytes()) {
                assert!(!read.is_signed_by(authority.certificate()), "byte {at} with {flip}");
            }
        }
    }
}

proptest! {
    /// Whatever a file holds, reading it ends in one line and without a panic.
    #[test]
    fn no_file_makes_the_reader_panic(
        bytes in proptest::collection::vec(any::<u8>(), 0..400),
        cut in 0_usize..900,
        flips in proptest::collection::vec((0_usize..700, any::<u8>()), 0..4),
        wrapped in any::<bool>(),
    ) {
        let authority = Authority::generate(name("demo"), 10).unwrap();
        let made = authority.issue(&robot("alpha"), &key(7).public(), DAYS).unwrap();
        let mut damaged = made.pem().as_bytes().to_vec();
        damaged.truncate(cut);
        let mut der = made.der.clone();
        for (at, value) in &flips {
            let (pem_at, der_at) = (at % damaged.len().max(1), at % der.len());
            if let Some(byte) = damaged.get_mut(pem_at) { *byte = *value; }
            der[der_at] = *value;
        }
        let raw = if wrapped { pem("CERTIFICATE", &bytes).into_bytes() } else { bytes };
        for content in [raw, damaged, pem("CERTIFICATE", &der).into_bytes()] {
            match Certificate::parse(&content) {
                Ok(read) if read.der != made.der => prop_assert!(!read.is_signed_by(authority.certificate())),
                Ok(_) => {}
                Err(problem) => {
                    let told = problem.at(Path::new("alpha.crt")).to_string();
                    prop_assert!(told.starts_with("alpha.crt: ") && told.lines().count() == 1, "{told}");
                    prop_assert!(["merganser keys", "name ", "copy "].iter().any(|cure| told.contains(cure)), "{told}");
                }
            }
        }
    }

    /// A text is one holder at most, and no robot's name is anything else.
    #[test]
    fn holders_are_told_apart(text in "[a-z:_.-]{0,20}") {
        if let Some(holder) = Holder::parse(&text) {
            prop_assert_eq!(holder.to_string(), text.clone());
            prop_assert_eq!(matches!(holder, Holder::Robot(_)), !text.contains(':'));
        }
    }
}
