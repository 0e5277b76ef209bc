//! Who is who: ed25519 keys as hexadecimal text. A robot's secret lives in a file of its own that only its user may
//! read; everybody's public halves stand in the roster of the configuration.

pub mod passphrase;

use core::fmt;
use ed25519_dalek::{SigningKey, VerifyingKey};
use passphrase::Passphrase;
use rand::{TryRng, rngs::SysRng};
use serde::{Deserialize, Serialize};
use std::fs::OpenOptions;
use std::io::{self, Read, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use thiserror::Error;
use zeroize::Zeroizing;

/// Bytes of a key.
pub const KEY_LEN: usize = 32;
/// Largest key file read, in bytes: 64 digits, or an encrypted key in PEM, and some white space.
const KEY_FILE_LEN_MAX: u64 = 1024;
/// Permission bits that a secret key file must not have.
const OTHERS: u32 = 0o077;

/// Why a key cannot be used.
#[derive(Debug, Error)]
pub enum TrustError {
    /// The file cannot be opened, read or written.
    #[error("key file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Others can read the file.
    #[error("key file {path} has mode {mode:04o}: others may read it; run `chmod 600 {path}`")]
    Mode {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The file does not hold a key.
    #[error("key file {path}: {source}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: KeyError,
    },
    /// The file is encrypted, and no passphrase is named.
    #[error(
        "key file {path} is encrypted: name its passphrase by key_passphrase_file or key_passphrase_env in the \
         configuration, or by --passphrase-file or --passphrase-env"
    )]
    Encrypted {
        /// The file.
        path: PathBuf,
    },
    /// The file is not encrypted, though a passphrase is named.
    #[error("key file {path} is not encrypted, but a passphrase is named for it; name none, or encrypt the key")]
    NotEncrypted {
        /// The file.
        path: PathBuf,
    },
    /// The file says that it is encrypted, and is no such file.
    #[error("key file {path} is damaged: it begins as an encrypted key does, and is none; take a copy of it")]
    NoEncryptedKey {
        /// The file.
        path: PathBuf,
    },
    /// The file is encrypted in a way that is not read, or holds another key.
    #[error("key file {path} cannot be read: {why}; encrypt the key anew, by `openssl pkcs8 -topk8 -scrypt`")]
    UnreadKey {
        /// The file.
        path: PathBuf,
        /// Why.
        why: String,
    },
    /// The passphrase does not open the file.
    #[error("key file {path}: the passphrase is wrong")]
    WrongPassphrase {
        /// The file.
        path: PathBuf,
    },
    /// There is no passphrase where one should be.
    #[error("passphrase: {0}")]
    Passphrase(String),
    /// The system gives no randomness.
    #[error("the system's random source failed: {0}")]
    Random(String),
}

/// Why a text is not a key.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum KeyError {
    /// Wrong number of digits.
    #[error("a key has 64 hexadecimal digits, this text has {0} characters")]
    Length(usize),
    /// A character that is no hexadecimal digit.
    #[error("{0:?} is no hexadecimal digit; a key has 64 of 0-9 and a-f")]
    Digit(char),
    /// The bytes are no point of the curve, or one that anybody can sign for.
    #[error("this is no ed25519 public key; copy the roster line that `merganser keys generate` printed")]
    NotAKey,
}

/// The public half of a robot's key, known to be a point of the curve and not a weak one.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct PublicKey([u8; KEY_LEN]);

impl PublicKey {
    /// Checks bytes.
    ///
    /// # Errors
    /// [`KeyError::NotAKey`] if they are no (strong) point of the curve.
    pub fn from_bytes(bytes: [u8; KEY_LEN]) -> Result<Self, KeyError> {
        match VerifyingKey::from_bytes(&bytes) {
            Ok(key) if !key.is_weak() => Ok(Self(bytes)),
            _ => Err(KeyError::NotAKey),
        }
    }

    /// The 32 bytes.
    pub fn to_bytes(self) -> [u8; KEY_LEN] {
        self.0
    }
}

impl TryFrom<String> for PublicKey {
    type Error = KeyError;
    fn try_from(text: String) -> Result<Self, KeyError> {
        Self::from_bytes(parse_hex(&text)?)
    }
}

impl From<PublicKey> for String {
    fn from(key: PublicKey) -> Self {
        to_hex(&key.0)
    }
}

impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&to_hex(&self.0))
    }
}

impl fmt::Debug for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A robot's secret key. Its text appears in no log: `Debug` shows nothing.
#[derive(Clone)]
pub struct SecretKey(SigningKey);

impl fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretKey(…)")
    }
}

impl SecretKey {
    /// A new key from the system's random source.
    ///
    /// # Errors
    /// [`TrustError::Random`] if there is none.
    pub fn generate() -> Result<Self, TrustError> {
        let mut bytes = [0; KEY_LEN];
        SysRng.try_fill_bytes(&mut bytes).map_err(|e| TrustError::Random(e.to_string()))?;
        Ok(Self::from_bytes(bytes))
    }

    /// The key with these bytes; any 32 bytes are one.
    pub fn from_bytes(bytes: [u8; KEY_LEN]) -> Self {
        Self(SigningKey::from_bytes(&bytes))
    }

    /// The 32 bytes, which are wiped from memory when they are dropped.
    pub fn to_bytes(&self) -> Zeroizing<[u8; KEY_LEN]> {
        Zeroizing::new(self.0.to_bytes())
    }

    /// The public half.
    pub fn public(&self) -> PublicKey {
        PublicKey(self.0.verifying_key().to_bytes())
    }

    /// Reads a key file that is not encrypted: 64 hexadecimal digits, readable by its owner alone.
    ///
    /// # Errors
    /// [`TrustError`] that says what is wrong with the file.
    pub fn load(path: &Path) -> Result<Self, TrustError> {
        Self::load_with(path, &Passphrase::None)
    }

    /// Reads a key file that is readable by its owner alone: encrypted, if a passphrase is named, and else plain.
    ///
    /// # Errors
    /// [`TrustError`] that says what is wrong with the file or the passphrase.
    pub fn load_with(path: &Path, passphrase: &Passphrase) -> Result<Self, TrustError> {
        let io = |source| TrustError::Io { path: path.into(), source };
        let file = std::fs::File::open(path).map_err(io)?;
        let mode = file.metadata().map_err(io)?.permissions().mode() & 0o7777;
        if mode & OTHERS != 0 {
            return Err(TrustError::Mode { path: path.into(), mode });
        }
        // With room for all of it, no copy is left behind by growing.
        let mut text = Zeroizing::new(String::with_capacity(KEY_FILE_LEN_MAX as usize + 1));
        file.take(KEY_FILE_LEN_MAX).read_to_string(&mut text).map_err(io)?;
        match (passphrase.read()?, passphrase::is_encrypted(&text)) {
            (Some(words), true) => passphrase::decrypt(&text, &words, path),
            (None, true) => Err(TrustError::Encrypted { path: path.into() }),
            (Some(_), false) => Err(TrustError::NotEncrypted { path: path.into() }),
            (None, false) => {
                let bytes = parse_hex(text.trim()).map(Zeroizing::new);
                let bytes = bytes.map_err(|source| TrustError::Content { path: path.into(), source })?;
                Ok(Self::from_bytes(*bytes))
            }
        }
    }

    /// Writes a new key file with mode 0600, not encrypted. An existing file is left alone: keys are never overwritten.
    ///
    /// # Errors
    /// [`TrustError::Io`].
    pub fn save(&self, path: &Path) -> Result<(), TrustError> {
        self.save_with(path, &Passphrase::None)
    }

    /// The same, encrypted if a passphrase is named.
    ///
    /// # Errors
    /// [`TrustError`].
    pub fn save_with(&self, path: &Path, passphrase: &Passphrase) -> Result<(), TrustError> {
        let io = |source| TrustError::Io { path: path.into(), source };
        let text = match passphrase.read()? {
            Some(words) => passphrase::encrypt(self, &words)?,
            None => Zeroizing::new(to_hex(&*self.to_bytes()) + "\n"),
        };
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path).map_err(io)?;
        file.write_all(text.as_bytes()).map_err(io)?;
        file.sync_all().map_err(io)
    }
}

/// Lower-case hexadecimal digits.
pub fn to_hex(bytes: &[u8]) -> String {
    use fmt::Write as _;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        let _ = write!(text, "{byte:02x}"); // a String takes any text
        text
    })
}

/// Bytes of 2·N hexadecimal digits.
///
/// # Errors
/// [`KeyError`] naming the first thing that does not fit.
pub fn parse_hex<const N: usize>(text: &str) -> Result<[u8; N], KeyError> {
    if let Some(bad) = text.chars().find(|c| !c.is_ascii_hexdigit()) {
        return Err(KeyError::Digit(bad));
    }
    if text.len() != 2 * N {
        return Err(KeyError::Length(text.len()));
    }
    let mut bytes = [0; N];
    for (byte, pair) in bytes.iter_mut().zip(text.as_bytes().chunks_exact(2)) {
        *byte = digit(pair[0]) << 4 | digit(pair[1]);
    }
    Ok(bytes)
}

/// The value of a character already known to be a hexadecimal digit.
fn digit(character: u8) -> u8 {
    match character {
        b'0'..=b'9' => character - b'0',
        _ => (character | 0x20) - b'a' + 10,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_survives_its_file_and_is_not_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("alpha.key");
        let key = SecretKey::generate().unwrap();
        key.save(&path).unwrap();
        assert_eq!(SecretKey::load(&path).unwrap().public(), key.public());
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(matches!(key.save(&path), Err(TrustError::Io { .. })));
        assert_ne!(SecretKey::generate().unwrap().public(), key.public());
    }

    #[test]
    fn a_key_that_others_can_read_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("alpha.key");
        SecretKey::from_bytes([7; 32]).save(&path).unwrap();
        for (mode, good) in [(0o600, true), (0o400, true), (0o640, false), (0o604, false), (0o610, false)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(SecretKey::load(&path).is_ok(), good, "{mode:o}");
        }
    }

    #[test]
    fn hex_is_checked() {
        assert_eq!(parse_hex::<2>("0aFf"), Ok([0x0a, 0xff]));
        assert_eq!(parse_hex::<2>("0aff0"), Err(KeyError::Length(5)));
        assert_eq!(parse_hex::<2>("0xff"), Err(KeyError::Digit('x')));
        assert_eq!(parse_hex::<2>("é0a"), Err(KeyError::Digit('é')));
        assert_eq!(to_hex(&[0x0a, 0xff]), "0aff");
    }

    #[test]
    fn weak_points_are_no_public_keys() {
        assert_eq!(PublicKey::from_bytes([0; 32]), Err(KeyError::NotAKey), "order 4");
        let mut one = [0; 32];
        one[0] = 1;
        assert_eq!(PublicKey::from_bytes(one), Err(KeyError::NotAKey), "the neutral element");
        assert!(PublicKey::from_bytes(SecretKey::from_bytes([7; 32]).public().to_bytes()).is_ok());
    }
}
