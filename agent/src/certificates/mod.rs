//! X.509 certificates, by which a Zenoh link knows who is at its other end. A swarm has an authority of its own; each
//! certificate that it signs carries a name and the very ed25519 key that stands in the roster under this name, so that
//! a robot has one secret for its facts and for its links.

pub mod authority;
pub mod credentials;
pub mod expiry;
pub mod router;
#[cfg(test)]
mod tests;

use crate::trust::PublicKey;
use core::fmt;
use ed25519_dalek::{Signature, VerifyingKey};
use merganser_protocol::ids::Name;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use thiserror::Error;
use x509_parser::pem::parse_x509_pem;
use x509_parser::prelude::{FromDer, X509Certificate};

/// Largest certificate or key file read, in bytes: one certificate takes about 600.
pub const FILE_LEN_MAX: u64 = 16_384;
/// How PEM begins a certificate, and any private key.
const BEGIN: &str = "-----BEGIN CERTIFICATE-----";
const PRIVATE: &str = "PRIVATE KEY-----";
/// Object identifier of Ed25519 (RFC 8410), for keys and signatures.
const ED25519: &str = "1.3.101.112";
/// What common names begin with that are no robot's. No robot's name and no name on the Internet has a colon.
const OBSERVER: &str = "observer:";
const ROUTER: &str = "router:";
const SWARM: &str = "swarm:";

/// Whom a certificate names.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Holder {
    /// A robot of the roster; its common name is the robot's.
    Robot(Name),
    /// Somebody who may read views.
    Observer(Name),
    /// A Zenoh router of the swarm.
    Router(Name),
    /// The authority of a swarm.
    Swarm(Name),
}

impl Holder {
    /// What a common name says, if it is one of ours.
    pub fn parse(text: &str) -> Option<Self> {
        let of = |prefix: &str| text.strip_prefix(prefix).map(|name| Name::new(name).ok());
        if let Some(name) = of(OBSERVER) {
            return name.map(Self::Observer);
        }
        if let Some(name) = of(ROUTER) {
            return name.map(Self::Router);
        }
        if let Some(name) = of(SWARM) {
            return name.map(Self::Swarm);
        }
        Name::new(text).ok().map(Self::Robot)
    }
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Robot(name) => write!(f, "{name}"),
            Self::Observer(name) => write!(f, "{OBSERVER}{name}"),
            Self::Router(name) => write!(f, "{ROUTER}{name}"),
            Self::Swarm(name) => write!(f, "{SWARM}{name}"),
        }
    }
}

/// Why a certificate or its key cannot be used: the file, what is wrong with it, and the cure.
#[derive(Debug, Error)]
#[error("{path}: {problem}", path = path.display())]
pub struct CertificateError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub problem: Problem,
}

/// What can be wrong with a certificate.
#[derive(Debug, Error)]
pub enum Problem {
    /// It cannot be read or written.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// It is not there.
    #[error(
        "No such file; `merganser keys authority` makes the one of a swarm, `merganser keys certificate` the others"
    )]
    Missing,
    /// It is too large.
    #[error("the file is larger than {FILE_LEN_MAX} bytes; is it a certificate that `merganser keys` made?")]
    Large,
    /// It holds no certificate.
    #[error("holds no certificate in PEM ({BEGIN} …); `merganser keys certificate` makes one")]
    NoPem,
    /// It holds a secret where a certificate belongs.
    #[error("holds a private key, where a certificate belongs; name the .crt file")]
    Private,
    /// It holds several certificates.
    #[error("holds {0} certificates; name a file with the one of this robot, or of this authority, alone")]
    Several(usize),
    /// What it holds is not encoded as a certificate is.
    #[error(
        "the certificate cannot be read ({0}); copy the file again, or make it anew by `merganser keys certificate`"
    )]
    Encoding(String),
    /// Its subject is none of ours.
    #[error("the common name is {0:?}, which names no robot, observer, router or swarm; make it by `merganser keys`")]
    Subject(String),
    /// Its key is not an ed25519 key.
    #[error("its key is no ed25519 key; make it by `merganser keys`, which takes the key of the roster")]
    Key,
    /// It names somebody else.
    #[error("is the certificate of {is}; here belongs the one of {wanted}")]
    Holder {
        /// Whom it names.
        is: Holder,
        /// Whom it should name.
        wanted: Holder,
    },
    /// Its key is another than the one of the roster or of the key file.
    #[error("carries the key {is}, but {wanted} is the one of {holder}; make it anew by `merganser keys certificate`")]
    OtherKey {
        /// Whose key it should be.
        holder: Holder,
        /// The key in the certificate.
        is: PublicKey,
        /// The key that it should be.
        wanted: PublicKey,
    },
    /// The authority did not sign it.
    #[error("is not signed by the authority {authority}; make it anew by `merganser keys certificate` with that one",
            authority = authority.display())]
    Unsigned {
        /// The file of the authority.
        authority: PathBuf,
    },
    /// It may sign no others.
    #[error("is no authority's certificate: it may not sign others; name the one that `merganser keys authority` made")]
    NoAuthority,
    /// It is over.
    #[error("expired on {0}; make it anew by `merganser keys certificate`")]
    Expired(String),
    /// The key file can be read by others.
    #[error("has mode {mode:04o}: others may read it; run `chmod 600 {path}`", path = path.display())]
    Mode {
        /// Its permission bits.
        mode: u32,
        /// The file.
        path: PathBuf,
    },
    /// The key file holds no key.
    #[error("holds no ed25519 key in PEM (PKCS #8); `merganser keys authority` makes one")]
    NoKey,
    /// A file is there that would be lost.
    #[error("is there already, and is not overwritten; remove it first, or choose another --out")]
    Exists,
    /// The maker of certificates failed.
    #[error("no certificate can be made: {0}")]
    Make(String),
}

impl Problem {
    /// The error about a file.
    pub fn at(self, path: &Path) -> CertificateError {
        CertificateError { path: path.into(), problem: self }
    }
}

/// A certificate of ours, read and understood; who signed it is not checked yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificate {
    pem: String,
    der: Vec<u8>,
    /// Whom it names.
    pub holder: Holder,
    /// Whose key it carries.
    pub key: PublicKey,
    /// First and last second of its validity, since 1970.
    pub not_before: i64,
    /// See `not_before`.
    pub not_after: i64,
    /// Whether it may sign others.
    pub is_authority: bool,
}

impl Certificate {
    /// Reads a file.
    ///
    /// # Errors
    /// [`CertificateError`] with the file's name.
    pub fn load(path: &Path) -> Result<Self, CertificateError> {
        let text = read_bounded(path).map_err(|problem| match problem {
            Problem::Io(error) if error.kind() == io::ErrorKind::NotFound => Problem::Missing.at(path),
            problem => problem.at(path),
        })?;
        Self::parse(&text).map_err(|problem| problem.at(path))
    }

    /// Reads the content of a file. Lines before and after the certificate are passed over.
    ///
    /// # Errors
    /// [`Problem`]; whatever the bytes are, it does not panic.
    pub fn parse(bytes: &[u8]) -> Result<Self, Problem> {
        let text = String::from_utf8_lossy(bytes);
        let Some(at) = text.find(BEGIN) else {
            return Err(if text.contains(PRIVATE) { Problem::Private } else { Problem::NoPem });
        };
        let count = text.matches(BEGIN).count();
        if count > 1 {
            return Err(Problem::Several(count));
        }
        let encoding = |reason: &dyn fmt::Display| Problem::Encoding(reason.to_string());
        let (_, pem) = parse_x509_pem(&text.as_bytes()[at..]).map_err(|error| encoding(&error))?;
        Self::from_der(pem.contents)
    }

    fn from_der(der: Vec<u8>) -> Result<Self, Problem> {
        let (rest, x509) = X509Certificate::from_der(&der).map_err(|error| Problem::Encoding(error.to_string()))?;
        if !rest.is_empty() {
            return Err(Problem::Encoding(format!("{} bytes too many", rest.len())));
        }
        let names: Vec<&str> = x509.subject().iter_common_name().filter_map(|name| name.as_str().ok()).collect();
        let holder = match names[..] {
            [name] => Holder::parse(name).ok_or_else(|| Problem::Subject(name.chars().take(64).collect()))?,
            _ => return Err(Problem::Subject(String::new())),
        };
        let spki = x509.public_key();
        let bytes = <[u8; 32]>::try_from(&*spki.subject_public_key.data).map_err(|_| Problem::Key)?;
        let is_ed25519 = spki.algorithm.algorithm.to_id_string() == ED25519;
        let key = PublicKey::from_bytes(bytes).ok().filter(|_| is_ed25519).ok_or(Problem::Key)?;
        let (not_before, not_after) = (x509.validity().not_before.timestamp(), x509.validity().not_after.timestamp());
        let is_authority = x509.is_ca();
        Ok(Self { pem: pem("CERTIFICATE", &der), der, holder, key, not_before, not_after, is_authority })
    }

    /// The certificate alone, in PEM.
    pub fn pem(&self) -> &str {
        &self.pem
    }

    /// Whether `authority` may sign, and signed this one. What the signature does not cover must be as it is due, to the
    /// bit: a certificate has one form.
    pub fn is_signed_by(&self, authority: &Self) -> bool {
        let parsed = (X509Certificate::from_der(&self.der), X509Certificate::from_der(&authority.der));
        let (Ok((_, own)), Ok((_, theirs))) = parsed else { return false };
        let Ok(signature) = Signature::from_slice(&own.signature_value.data) else { return false };
        let Ok(key) = VerifyingKey::from_bytes(&authority.key.to_bytes()) else { return false };
        let signed = own.tbs_certificate.as_ref();
        authority.is_authority
            && own.issuer() == theirs.subject()
            && self.der == sealed(signed, &own.signature_value.data)
            && key.verify_strict(signed, &signature).is_ok()
    }

    /// Its last day, as in `2027-11-29`.
    pub fn last_day(&self) -> String {
        day(self.not_after)
    }
}

/// DER of a certificate: a sequence of what is signed, the algorithm, which is Ed25519, and the signature, a bit string.
fn sealed(signed: &[u8], signature: &[u8]) -> Vec<u8> {
    const SEQUENCE: u8 = 0x30;
    const ALGORITHM: [u8; 7] = [SEQUENCE, 5, 6, 3, 0x2b, 0x65, 0x70];
    const BITS: [u8; 3] = [3, 65, 0];
    let content = [signed, &ALGORITHM, &BITS, signature].concat();
    let length = content.len().to_be_bytes();
    let first = length.iter().take_while(|byte| **byte == 0).count();
    let length = &length[first..];
    let head = if let [short @ 0..=127] = *length {
        vec![SEQUENCE, short]
    } else {
        [&[SEQUENCE, 0x80 | length.len() as u8], length].concat()
    };
    [head, content].concat()
}

/// The day of a second since 1970, as in `2027-11-29`.
pub fn day(secs: i64) -> String {
    time::OffsetDateTime::from_unix_timestamp(secs).map_or_else(|_| format!("second {secs}"), |t| t.date().to_string())
}

/// PEM as RFC 7468 writes it.
fn pem(label: &str, der: &[u8]) -> String {
    use base64::Engine as _;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    let mut pem = format!("-----BEGIN {label}-----\n");
    let mut rest = text.as_str();
    while !rest.is_empty() {
        let (line, after) = rest.split_at(rest.len().min(64));
        pem.push_str(line);
        pem.push('\n');
        rest = after;
    }
    pem + &format!("-----END {label}-----\n")
}

fn read_bounded(path: &Path) -> Result<Vec<u8>, Problem> {
    let file = std::fs::File::open(path)?;
    let mut bytes = Vec::new();
    file.take(FILE_LEN_MAX + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > FILE_LEN_MAX {
        return Err(Problem::Large);
    }
    Ok(bytes)
}
