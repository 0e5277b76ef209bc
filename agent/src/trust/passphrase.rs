//! Encrypted key files: PKCS #8 in PEM, by a passphrase (PBES2 with scrypt and AES-256-CBC), as `openssl pkey` reads and
//! writes them. The passphrase comes from a file that only its owner may read, or from an environment variable; it is
//! asked of nobody, for agents start by themselves.

use super::{KEY_LEN, OTHERS, SecretKey, TrustError};
use pkcs8::der::Decode;
use pkcs8::der::SecretDocument;
use pkcs8::der::pem::PemLabel;
use pkcs8::pkcs5::EncryptionScheme;
use pkcs8::pkcs5::pbes2::Kdf;
use pkcs8::{EncryptedPrivateKeyInfoRef, LineEnding, PrivateKeyInfoRef, pkcs5};
use rand::rngs::SysRng;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use zeroize::Zeroizing;

/// Longest passphrase, in bytes.
pub const PASSPHRASE_LEN_MAX: usize = 1024;
/// Most memory, in bytes, that deriving the key of a file may take: 128 N r of scrypt. `keys generate` and openssl take 16
/// MiB.
pub const SCRYPT_BYTES_MAX: u64 = 64 << 20;
/// Most passes of scrypt (p), and of PBKDF2, the other way that openssl has: seconds on a small computer.
pub const SCRYPT_PASSES_MAX: u16 = 16;
/// See [`SCRYPT_PASSES_MAX`].
pub const PBKDF2_PASSES_MAX: u32 = 4_000_000;
/// First line of an encrypted key file.
const BEGIN: &str = "-----BEGIN ENCRYPTED PRIVATE KEY-----";
/// What stands before the 32 bytes of a secret ed25519 key in DER (PKCS #8, RFC 8410).
const DER_HEAD: [u8; 16] =
    [0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20];

/// Where the passphrase of a key file is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Passphrase {
    /// The key file is not encrypted.
    #[default]
    None,
    /// The first line of this file.
    File(PathBuf),
    /// The value of this environment variable.
    Env(String),
}

impl Passphrase {
    /// Of two options of which one may be given.
    pub fn of(file: Option<PathBuf>, env: Option<String>) -> Self {
        match (file, env) {
            (Some(file), _) => Self::File(file),
            (None, Some(env)) => Self::Env(env),
            (None, None) => Self::None,
        }
    }

    /// The passphrase, if there is one.
    ///
    /// # Errors
    /// [`TrustError::Passphrase`], [`TrustError::Io`] or [`TrustError::Mode`].
    pub fn read(&self) -> Result<Option<Zeroizing<Vec<u8>>>, TrustError> {
        let refuse = |why: String| Err(TrustError::Passphrase(why));
        let (bytes, from) = match self {
            Self::None => return Ok(None),
            Self::Env(name) => {
                let Some(value) = std::env::var_os(name) else {
                    return refuse(format!("the environment variable {name} is not set"));
                };
                (Zeroizing::new(value.into_encoded_bytes()), format!("the environment variable {name}"))
            }
            Self::File(path) => (of_file(path)?, path.display().to_string()),
        };
        if bytes.is_empty() {
            return refuse(format!("{from} is empty; write the passphrase there"));
        }
        if bytes.len() > PASSPHRASE_LEN_MAX {
            return refuse(format!("{from} holds more than {PASSPHRASE_LEN_MAX} bytes; is it a passphrase?"));
        }
        Ok(Some(bytes))
    }
}

/// A file's first line.
fn of_file(path: &Path) -> Result<Zeroizing<Vec<u8>>, TrustError> {
    let io = |source| TrustError::Io { path: path.into(), source };
    let file = File::open(path).map_err(io)?;
    let mode = file.metadata().map_err(io)?.permissions().mode() & 0o7777;
    if mode & OTHERS != 0 {
        return Err(TrustError::Mode { path: path.into(), mode });
    }
    // With room for all of it, no copy is left behind by growing.
    let mut bytes = Zeroizing::new(Vec::with_capacity(PASSPHRASE_LEN_MAX + 3));
    file.take(PASSPHRASE_LEN_MAX as u64 + 2).read_to_end(&mut bytes).map_err(io)?;
    if let Some(end) = bytes.iter().position(|byte| matches!(byte, b'\n' | b'\r')) {
        bytes.truncate(end);
    }
    Ok(bytes)
}

/// A secret ed25519 key in DER.
pub(crate) fn key_der(secret: &[u8; KEY_LEN]) -> Zeroizing<Vec<u8>> {
    let mut der = Zeroizing::new(Vec::with_capacity(DER_HEAD.len() + KEY_LEN));
    der.extend_from_slice(&DER_HEAD);
    der.extend_from_slice(secret);
    der
}

/// Whether the text of a key file is encrypted.
pub(super) fn is_encrypted(text: &str) -> bool {
    text.trim_start().starts_with(BEGIN)
}

/// The text of an encrypted key file.
pub(super) fn encrypt(key: &SecretKey, passphrase: &[u8]) -> Result<Zeroizing<String>, TrustError> {
    let failed = |error: pkcs8::Error| TrustError::Passphrase(format!("the key cannot be encrypted: {error}"));
    let der = key_der(&key.to_bytes());
    let info = PrivateKeyInfoRef::from_der(&der).map_err(|error| failed(error.into()))?;
    let encrypted = info.encrypt_with_rng(&mut SysRng, passphrase).map_err(failed)?;
    encrypted.to_pem(EncryptedPrivateKeyInfoRef::PEM_LABEL, LineEnding::LF).map_err(|error| failed(error.into()))
}

/// The key in the text of an encrypted file.
pub(super) fn decrypt(text: &str, passphrase: &[u8], path: &Path) -> Result<SecretKey, TrustError> {
    let damaged = || TrustError::NoEncryptedKey { path: path.into() };
    let (_, document) = SecretDocument::from_pem(text.trim()).map_err(|_| damaged())?;
    let info = EncryptedPrivateKeyInfoRef::from_der(document.as_bytes()).map_err(|_| damaged())?;
    let unread = |why: &str| TrustError::UnreadKey { path: path.into(), why: why.into() };
    if !is_bounded(&info.encryption_algorithm) {
        return Err(unread(
            "it asks for more work than a small computer has, or is encrypted in another way than PBES2",
        ));
    }
    // A wrong passphrase shows as wrong padding, or as bytes that are no key.
    let wrong = || TrustError::WrongPassphrase { path: path.into() };
    let clear = info.decrypt(passphrase).map_err(|error| match error {
        pkcs8::Error::EncryptedPrivateKey(
            other @ (pkcs5::Error::UnsupportedAlgorithm { .. } | pkcs5::Error::AlgorithmParametersInvalid { .. }),
        ) => unread(&other.to_string()),
        _ => wrong(),
    })?;
    let Some(secret) = clear.as_bytes().strip_prefix(&DER_HEAD) else {
        let is_key = PrivateKeyInfoRef::from_der(clear.as_bytes()).is_ok();
        return Err(if is_key { unread("what is in it is no ed25519 key of version 1") } else { wrong() });
    };
    let secret = Zeroizing::new(<[u8; KEY_LEN]>::try_from(secret).map_err(|_| wrong())?);
    Ok(SecretKey::from_bytes(*secret))
}

/// Whether deriving the key takes what a small computer has, and the numbers of its file are such as the derivation takes.
fn is_bounded(scheme: &EncryptionScheme) -> bool {
    let EncryptionScheme::Pbes2(parameters) = scheme else { return false };
    match &parameters.kdf {
        Kdf::Scrypt(scrypt) => {
            let bytes = scrypt.cost_parameter.checked_mul(128 * u64::from(scrypt.block_size));
            (scrypt.cost_parameter >= 2 && scrypt.cost_parameter.is_power_of_two())
                && bytes.is_some_and(|bytes| (1..=SCRYPT_BYTES_MAX).contains(&bytes))
                && (1..=SCRYPT_PASSES_MAX).contains(&scrypt.parallelization)
        }
        Kdf::Pbkdf2(pbkdf2) => (1..=PBKDF2_PASSES_MAX).contains(&pbkdf2.iteration_count),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pkcs8::der::EncodePem;
    use std::fs;

    fn folder_with(passphrase: &str, mode: u32) -> (tempfile::TempDir, Passphrase) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("passphrase");
        fs::write(&path, passphrase).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        (folder, Passphrase::File(path))
    }

    #[test]
    fn an_encrypted_key_survives_its_file_and_opens_by_its_passphrase_alone() {
        let (folder, good) = folder_with("correct horse\n", 0o600);
        let (_other, wrong) = folder_with("correct house", 0o600);
        let path = folder.path().join("alpha.key");
        let key = SecretKey::generate().unwrap();
        key.save_with(&path, &good).unwrap();
        assert!(is_encrypted(&fs::read_to_string(&path).unwrap()));
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(SecretKey::load_with(&path, &good).unwrap().public(), key.public());
        assert!(matches!(SecretKey::load_with(&path, &wrong), Err(TrustError::WrongPassphrase { .. })));
        assert!(matches!(SecretKey::load(&path), Err(TrustError::Encrypted { .. })));
        let plain = folder.path().join("beta.key");
        key.save(&plain).unwrap();
        assert!(matches!(SecretKey::load_with(&plain, &good), Err(TrustError::NotEncrypted { .. })));
        for damage in ["-----BEGIN ENCRYPTED PRIVATE KEY-----\nMAA=\n-----END ENCRYPTED PRIVATE KEY-----\n", BEGIN] {
            fs::write(&path, damage).unwrap();
            assert!(matches!(SecretKey::load_with(&path, &good), Err(TrustError::NoEncryptedKey { .. })), "{damage}");
        }
    }

    #[test]
    fn what_no_small_computer_derives_and_other_keys_are_told_as_such() {
        let (folder, good) = folder_with("correct horse", 0o600);
        let path = folder.path().join("alpha.key");
        SecretKey::generate().unwrap().save_with(&path, &good).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let (_, document) = SecretDocument::from_pem(text.trim()).unwrap();
        let opened = |change: &dyn Fn(&mut pkcs5::pbes2::ScryptParams)| {
            let mut info = EncryptedPrivateKeyInfoRef::from_der(document.as_bytes()).unwrap();
            let EncryptionScheme::Pbes2(parameters) = &mut info.encryption_algorithm else { panic!("PBES2") };
            let Kdf::Scrypt(scrypt) = &mut parameters.kdf else { panic!("scrypt") };
            change(scrypt);
            let pem = info.to_pem(LineEnding::LF).unwrap();
            fs::write(&path, pem.as_bytes()).unwrap();
            SecretKey::load_with(&path, &good).map(|_| ())
        };
        assert!(opened(&|_| {}).is_ok());
        let largest = SCRYPT_BYTES_MAX / (128 * 8);
        // At the bound the passphrase is tried, and does not fit what is changed; beyond it nothing is derived.
        assert!(matches!(opened(&|scrypt| scrypt.cost_parameter = largest), Err(TrustError::WrongPassphrase { .. })));
        for cost in [0, 1, 3, 2 * largest, 1 << 40, u64::MAX] {
            let refused = opened(&|scrypt| scrypt.cost_parameter = cost);
            assert!(matches!(refused, Err(TrustError::UnreadKey { .. })), "{cost}");
        }
        for (size, passes) in [(0, 1), (8, 0), (8, SCRYPT_PASSES_MAX + 1), (u16::MAX, 1)] {
            let refused = opened(&|scrypt| (scrypt.block_size, scrypt.parallelization) = (size, passes));
            assert!(matches!(refused, Err(TrustError::UnreadKey { .. })), "{size} {passes}");
        }
        // A key of X25519: by its algorithm's last byte.
        let mut der = key_der(&[7; KEY_LEN]).to_vec();
        der[11] = 0x6e;
        let other = PrivateKeyInfoRef::from_der(&der).unwrap().encrypt_with_rng(&mut SysRng, b"correct horse").unwrap();
        fs::write(&path, other.to_pem(EncryptedPrivateKeyInfoRef::PEM_LABEL, LineEnding::LF).unwrap().as_bytes())
            .unwrap();
        let refused = SecretKey::load_with(&path, &good).unwrap_err().to_string();
        assert!(refused.contains("no ed25519 key") && refused.contains("openssl"), "{refused}");
    }

    #[test]
    fn a_passphrase_is_the_first_line_of_a_file_that_nobody_else_reads() {
        for (text, mode, wanted) in [
            ("a b\n", 0o600, Some("a b")),
            ("a b\r\nmore", 0o400, Some("a b")),
            ("x", 0o644, None),
            ("", 0o600, None),
            ("\nx", 0o600, None),
            (&"x".repeat(PASSPHRASE_LEN_MAX), 0o600, Some(&*"x".repeat(PASSPHRASE_LEN_MAX))),
            (&"x".repeat(PASSPHRASE_LEN_MAX + 1), 0o600, None),
        ] {
            let (_folder, passphrase) = folder_with(text, mode);
            let read = passphrase.read();
            match wanted {
                Some(wanted) => assert_eq!(read.unwrap().unwrap().as_slice(), wanted.as_bytes()),
                None => assert!(read.is_err(), "{text:?} {mode:o}"),
            }
        }
        assert!(matches!(Passphrase::Env("MERGANSER_NOT_SET".into()).read(), Err(TrustError::Passphrase(_))));
        assert_eq!(Passphrase::None.read().unwrap(), None);
    }
}
