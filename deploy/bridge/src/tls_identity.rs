//! The certificates of `tls/` endpoints, which each process makes in memory from the run's token.
//!
//! Both ends derive the same certificate authority from the token. Each presents a certificate that
//! this authority has signed, with a key of its own, and accepts no other. So only those who know
//! the token can connect. Certificates do not expire, because a clock that is wrong would otherwise
//! cut a host off, and who knows the token can make new ones at any time.

use std::sync::Arc;

use anyhow::Context;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    PKCS_ED25519,
};
use rustls::crypto::ring;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore, ServerConfig};

use crate::keys::{KEY_BYTES, Key};

/// Name in the certificates of all processes. The authority identifies the run, whatever name or
/// address the user connects to.
pub(crate) const NAME: &str = "dmprl";
/// PKCS#8 of an Ed25519 private key (RFC 8410, section 7), up to the key itself.
const ED25519_PKCS8: [u8; 16] = [
    0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20,
];

/// Certificates and key of one process.
pub(crate) struct TlsIdentity {
    /// The run's certificate authority.
    authority: CertificateDer<'static>,
    /// The certificate of this process.
    certificate: CertificateDer<'static>,
    /// Its private key.
    private_key: PrivateKeyDer<'static>,
}

impl TlsIdentity {
    /// Makes a certificate for this process.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub(crate) fn new(token: &str) -> anyhow::Result<Self> {
        Self::signed(token).context("cannot make certificates from the token")
    }

    fn signed(token: &str) -> Result<Self, rcgen::Error> {
        let secret = Key::from_token(token, "dmprl bridge 2: certificate authority");
        let mut pkcs8 = [0; ED25519_PKCS8.len() + KEY_BYTES];
        pkcs8[..ED25519_PKCS8.len()].copy_from_slice(&ED25519_PKCS8);
        pkcs8[ED25519_PKCS8.len()..].copy_from_slice(secret.bytes());
        let authority_key =
            KeyPair::from_pkcs8_der_and_sign_algo(&pkcs8.as_slice().into(), &PKCS_ED25519)?;
        let mut params = CertificateParams::new(Vec::new())?;
        params.distinguished_name.push(DnType::CommonName, "dmprl run");
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
        let authority = params.self_signed(&authority_key)?;
        let issuer = Issuer::new(params, authority_key);
        let key = KeyPair::generate()?;
        let certificate =
            CertificateParams::new(vec![NAME.to_owned()])?.signed_by(&key, &issuer)?;
        Ok(Self {
            authority: authority.der().clone(),
            certificate: certificate.der().clone(),
            private_key: PrivatePkcs8KeyDer::from(key.serialize_der()).into(),
        })
    }

    fn roots(&self) -> Result<Arc<RootCertStore>, rustls::Error> {
        let mut roots = RootCertStore::empty();
        roots.add(self.authority.clone())?;
        Ok(Arc::new(roots))
    }

    /// The listening end's configuration, which accepts only clients of the run.
    ///
    /// # Errors
    /// Never for certificates that this module made.
    pub(crate) fn server(self) -> anyhow::Result<ServerConfig> {
        let provider = Arc::new(ring::default_provider());
        let clients =
            WebPkiClientVerifier::builder_with_provider(self.roots()?, Arc::clone(&provider));
        let config = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .with_client_cert_verifier(clients.build()?)
            .with_single_cert(vec![self.certificate], self.private_key)?;
        Ok(config)
    }

    /// The connecting end's configuration, which accepts only servers of the run.
    ///
    /// # Errors
    /// Never for certificates that this module made.
    pub(crate) fn client(self) -> anyhow::Result<ClientConfig> {
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&TLS13])?
            .with_root_certificates(self.roots()?)
            .with_client_auth_cert(vec![self.certificate], self.private_key)?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processes_of_a_run_share_an_authority_but_no_key() {
        let [one, two] = [0; 2].map(|_| TlsIdentity::new("a secret of some length").unwrap());
        assert_eq!(one.authority, two.authority);
        assert_ne!(one.certificate, two.certificate);
        assert_ne!(one.private_key, two.private_key);
        let other = TlsIdentity::new("another secret of some length").unwrap();
        assert_ne!(one.authority, other.authority);
    }
}
