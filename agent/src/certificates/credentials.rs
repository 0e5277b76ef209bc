//! What a session needs to open and accept links by TLS: the swarm's authority, a certificate and its key, and the names
//! of all who may link. All of it is checked before Zenoh sees it, whose own messages name neither file nor cure.

use super::authority::key_pem;
use super::{Certificate, CertificateError, Holder, Problem};
use crate::trust::{PublicKey, SecretKey};
use core::fmt;
use merganser_protocol::ids::Name;
use std::collections::BTreeSet;
use std::path::Path;
use zeroize::Zeroizing;

/// Everybody with a part in a swarm, by name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Members {
    /// Robots of the roster.
    pub robots: BTreeSet<Name>,
    /// Who may read views.
    pub observers: BTreeSet<Name>,
    /// Zenoh routers.
    pub routers: BTreeSet<Name>,
}

/// See the module. `Debug` shows no key.
#[derive(Clone)]
pub struct Credentials {
    /// The authority's certificate.
    pub authority: Certificate,
    /// The holder's own.
    pub certificate: Certificate,
    key_pem: Zeroizing<String>,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Credentials({} of {}, …)", self.certificate.holder, self.authority.holder)
    }
}

/// The files of a holder.
#[derive(Clone, Copy, Debug)]
pub struct Files<'a> {
    /// The certificate.
    pub certificate: &'a Path,
    /// The authority's certificate.
    pub authority: &'a Path,
}

impl Credentials {
    /// Reads and checks both certificates against each other, the holder and its key. Whether they are over is not
    /// checked: a robot whose clock is wrong must start.
    ///
    /// # Errors
    /// [`CertificateError`] for the first that does not fit.
    pub fn load(files: Files<'_>, swarm: &Name, holder: &Holder, key: &SecretKey) -> Result<Self, CertificateError> {
        let authority = authority(files.authority, swarm)?;
        let certificate = Certificate::load(files.certificate)?;
        let at = |problem: Problem| Err(problem.at(files.certificate));
        if certificate.holder != *holder {
            return at(Problem::Holder { is: certificate.holder, wanted: holder.clone() });
        }
        let wanted: PublicKey = key.public();
        if certificate.key != wanted {
            return at(Problem::OtherKey { holder: holder.clone(), is: certificate.key, wanted });
        }
        if !certificate.is_signed_by(&authority) {
            return at(Problem::Unsigned { authority: files.authority.into() });
        }
        Ok(Self::new(authority, certificate, key))
    }

    /// Of parts that are known to fit.
    pub fn new(authority: Certificate, certificate: Certificate, key: &SecretKey) -> Self {
        Self { authority, certificate, key_pem: key_pem(&key.to_bytes()) }
    }

    /// The secret key in PEM, for Zenoh alone.
    pub(crate) fn key_pem(&self) -> &str {
        &self.key_pem
    }
}

/// Reads the certificate of a swarm's authority.
///
/// # Errors
/// [`CertificateError`] if it is none, or another swarm's.
pub fn authority(path: &Path, swarm: &Name) -> Result<Certificate, CertificateError> {
    let authority = Certificate::load(path)?;
    if !authority.is_authority {
        return Err(Problem::NoAuthority.at(path));
    }
    let wanted = Holder::Swarm(swarm.clone());
    if authority.holder != wanted {
        return Err(Problem::Holder { is: authority.holder, wanted }.at(path));
    }
    Ok(authority)
}
