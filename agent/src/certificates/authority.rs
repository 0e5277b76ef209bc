//! A swarm's authority: made once on a computer that is not on the radio, and needed only when certificates are made.
//! It signs public keys, so that no robot's secret leaves the robot.

use super::{Certificate, CertificateError, Holder, Problem, pem, read_bounded};
use crate::trust::PublicKey;
use crate::trust::passphrase::key_der;
use core::fmt;
use merganser_protocol::ids::Name;
use rand::{TryRng, rngs::SysRng};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, PKCS_ED25519, PublicKeyData, SerialNumber, SignatureAlgorithm,
};
use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use time::{Duration, OffsetDateTime};
use zeroize::Zeroizing;

/// Longest validity, in days.
pub const DAYS_MAX: u32 = 36_500;
/// Validity of certificates if nothing else is said, in days.
pub const DAYS: u32 = 365;
/// The same of an authority.
pub const AUTHORITY_DAYS: u32 = 3_650;
/// How long before it was made a certificate is valid, for hosts whose clocks are behind.
const BACKDATED: Duration = Duration::DAY;
/// Permission bits that a secret key file must not have.
const OTHERS: u32 = 0o077;

/// An authority with its secret key.
pub struct Authority {
    key: KeyPair,
    certificate: Certificate,
    swarm: Name,
}

impl fmt::Debug for Authority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Authority({}, …)", self.swarm)
    }
}

/// Where an authority's certificate and key are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Files {
    /// The certificate, which every robot gets.
    pub certificate: PathBuf,
    /// The key, which nobody gets.
    pub key: PathBuf,
}

impl Files {
    /// Those of a swarm in a folder.
    pub fn of(swarm: &Name, folder: &Path) -> Self {
        let file = |ending: &str| folder.join(format!("{swarm}.authority.{ending}"));
        Self { certificate: file("crt"), key: file("key") }
    }

    /// Those with this key file; the certificate lies beside it.
    pub fn of_key(key: &Path) -> Self {
        Self { certificate: key.with_extension("crt"), key: key.into() }
    }
}

/// A public key for `rcgen`.
struct Ed25519([u8; 32]);

impl PublicKeyData for Ed25519 {
    fn der_bytes(&self) -> &[u8] {
        &self.0
    }
    fn algorithm(&self) -> &'static SignatureAlgorithm {
        &PKCS_ED25519
    }
}

impl Authority {
    /// A new authority.
    ///
    /// # Errors
    /// [`Problem::Make`].
    pub fn generate(swarm: Name, days: u32) -> Result<Self, Problem> {
        let key = KeyPair::generate_for(&PKCS_ED25519).map_err(made)?;
        let mut params = params(&Holder::Swarm(swarm.clone()), OffsetDateTime::now_utc(), days)?;
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let certificate = params.self_signed(&key).map_err(made)?;
        let certificate = Certificate::from_der(certificate.der().to_vec())?;
        Ok(Self { key, certificate, swarm })
    }

    /// Reads an authority: its key, and the certificate beside it.
    ///
    /// # Errors
    /// [`CertificateError`] that names the file and the cure.
    pub fn load(files: &Files) -> Result<Self, CertificateError> {
        let Files { certificate: path, key } = files;
        let at = |problem: Problem| problem.at(key);
        let mode = fs::metadata(key).map_err(|error| at(error.into()))?.permissions().mode() & 0o7777;
        if mode & OTHERS != 0 {
            return Err(at(Problem::Mode { mode, path: key.clone() }));
        }
        let text = Zeroizing::new(read_bounded(key).map_err(at)?);
        let text = core::str::from_utf8(&text).map_err(|_| at(Problem::NoKey))?;
        let secret = KeyPair::from_pkcs8_pem_and_sign_algo(text, &PKCS_ED25519).map_err(|_| at(Problem::NoKey))?;
        let certificate = Certificate::load(path)?;
        let Holder::Swarm(swarm) = certificate.holder.clone() else { return Err(Problem::NoAuthority.at(path)) };
        if !certificate.is_authority {
            return Err(Problem::NoAuthority.at(path));
        }
        let public = <[u8; 32]>::try_from(secret.public_key_raw()).map_err(|_| at(Problem::NoKey))?;
        let wanted = PublicKey::from_bytes(public).map_err(|_| at(Problem::NoKey))?;
        if wanted != certificate.key {
            let (holder, is) = (certificate.holder.clone(), certificate.key);
            return Err(Problem::OtherKey { holder, is, wanted }.at(path));
        }
        Ok(Self { key: secret, certificate, swarm })
    }

    /// Writes both files, the key with mode 0600. What is there is left alone.
    ///
    /// # Errors
    /// [`CertificateError`].
    pub fn save(&self, files: &Files) -> Result<(), CertificateError> {
        write_new(&files.certificate, self.certificate.pem(), 0o644)?;
        write_new(&files.key, &Zeroizing::new(self.key.serialize_pem()), 0o600).inspect_err(|_| {
            // Beside another key it would be of no use, and in the way of the next try.
            let _ = fs::remove_file(&files.certificate);
        })
    }

    /// The swarm that it speaks for.
    pub fn swarm(&self) -> &Name {
        &self.swarm
    }

    /// Its own certificate.
    pub fn certificate(&self) -> &Certificate {
        &self.certificate
    }

    /// A certificate for whoever has the secret half of `key`.
    ///
    /// # Errors
    /// [`Problem::Make`].
    pub fn issue(&self, holder: &Holder, key: &PublicKey, days: u32) -> Result<Certificate, Problem> {
        self.issue_at(holder, key, OffsetDateTime::now_utc(), days)
    }

    /// The same as if it were made at another time.
    ///
    /// # Errors
    /// [`Problem::Make`].
    pub fn issue_at(
        &self,
        holder: &Holder,
        key: &PublicKey,
        now: OffsetDateTime,
        days: u32,
    ) -> Result<Certificate, Problem> {
        let mut params = params(holder, now, days)?;
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.use_authority_key_identifier_extension = true;
        // An observer calls others, and is not called.
        params.extended_key_usages = match holder {
            Holder::Observer(_) => vec![ExtendedKeyUsagePurpose::ClientAuth],
            _ => vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth],
        };
        let mut own = CertificateParams::default();
        own.distinguished_name = subject(&self.certificate.holder);
        let issued = params.signed_by(&Ed25519(key.to_bytes()), &Issuer::from_params(&own, &self.key)).map_err(made)?;
        Certificate::from_der(issued.der().to_vec())
    }
}

fn params(holder: &Holder, now: OffsetDateTime, days: u32) -> Result<CertificateParams, Problem> {
    let mut serial = [0; 16];
    SysRng.try_fill_bytes(&mut serial).map_err(made)?;
    serial[0] = serial[0] & 0x7f | 0x40; // positive, and as long as it is
    let mut params = CertificateParams::default();
    params.serial_number = Some(SerialNumber::from_slice(&serial));
    params.distinguished_name = subject(holder);
    let bounds = (now.checked_sub(BACKDATED), now.checked_add(Duration::days(days.into())));
    let (Some(begin), Some(end)) = bounds else { return Err(made("this host's clock is out of range")) };
    (params.not_before, params.not_after) = (begin, end);
    Ok(params)
}

fn subject(holder: &Holder) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::CommonName, holder.to_string());
    name
}

fn made(reason: impl fmt::Display) -> Problem {
    Problem::Make(reason.to_string())
}

/// A secret ed25519 key in PEM (PKCS #8, RFC 8410), wiped from memory when it is dropped.
pub fn key_pem(secret: &[u8; 32]) -> Zeroizing<String> {
    Zeroizing::new(pem("PRIVATE KEY", &key_der(secret)))
}

/// Writes a file that is not there yet.
///
/// # Errors
/// [`Problem::Exists`] or [`Problem::Io`].
pub fn write_new(path: &Path, text: &str, mode: u32) -> Result<(), CertificateError> {
    let file = OpenOptions::new().write(true).create_new(true).mode(mode).open(path);
    let mut file = file.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => Problem::Exists.at(path),
        _ => Problem::Io(error).at(path),
    })?;
    file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(|error| Problem::Io(error).at(path))
}

/// Writes a certificate, over the one that it renews. A cut in between leaves one or the other.
///
/// # Errors
/// [`Problem::Io`].
pub fn write_over(path: &Path, text: &str) -> Result<(), CertificateError> {
    let at = |error| Problem::Io(error).at(path);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(folder).map_err(at)?;
    file.write_all(text.as_bytes()).and_then(|()| file.as_file().sync_all()).map_err(at)?;
    fs::set_permissions(file.path(), fs::Permissions::from_mode(0o644)).map_err(at)?;
    file.persist(path).map(drop).map_err(|error| at(error.error))
}
