//! Copy of the shipped security files in a temporary folder, with new certificates.

use std::path::{Path, PathBuf};

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use tempfile::TempDir;

/// Folder of the shipped files.
const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/security");
/// Prefix of the paths with which the shipped files refer to each other.
const PREFIX: &str = "examples/security/";

/// Any error while the folder is created.
pub type Failure = Box<dyn std::error::Error + Send + Sync>;

/// A copy of `examples/security` with adapted paths and new certificates. It is deleted when dropped.
///
/// The certificates are those of an authority, of a server for `127.0.0.1`, and of a client with the common name
/// `alice`.
pub struct SecurityFolder(TempDir);

impl SecurityFolder {
    /// Copies the shipped files and creates the certificates.
    pub fn new() -> Result<Self, Failure> {
        let folder = Self(TempDir::new()?);
        for entry in std::fs::read_dir(SHIPPED)? {
            let name = entry?.file_name().to_string_lossy().into_owned();
            if [".json5", ".txt"].iter().any(|extension| name.ends_with(extension)) {
                let text = std::fs::read_to_string(Path::new(SHIPPED).join(&name))?;
                folder.write(&name, &text.replace(PREFIX, &format!("{}/", folder.0.path().display())))?;
            }
        }
        folder.make_certificates()?;
        Ok(folder)
    }

    /// Returns the path of the file `name`.
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file into the folder and returns its path.
    pub fn write(&self, name: &str, text: &str) -> std::io::Result<PathBuf> {
        let path = self.path(name);
        std::fs::write(&path, text)?;
        Ok(path)
    }

    /// Writes a copy of the file `name` with `from` replaced by `to`, and returns its path.
    pub fn edited(&self, name: &str, from: &str, to: &str) -> Result<PathBuf, Failure> {
        let text = std::fs::read_to_string(self.path(name))?;
        if !text.contains(from) {
            return Err(format!("{name} does not contain {from}").into());
        }
        Ok(self.write(&format!("edited-{name}"), &text.replace(from, to))?)
    }

    /// Writes a copy of the file `name` with its commented-out settings enabled, and returns its path.
    pub fn uncommented(&self, name: &str) -> Result<PathBuf, Failure> {
        let text = std::fs::read_to_string(self.path(name))?;
        let lines: Vec<&str> = text.lines().map(|line| commented_setting(line).unwrap_or(line)).collect();
        Ok(self.write(&format!("uncommented-{name}"), &lines.join("\n"))?)
    }

    fn make_certificates(&self) -> Result<(), Failure> {
        let authority_key = KeyPair::generate()?;
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(DnType::CommonName, "Twinstep test authority");
        self.write("ca.pem", &params.self_signed(&authority_key)?.pem())?;
        let authority = Issuer::new(params, authority_key);
        for (file, common_name, hosts) in
            [("server", "server", vec!["127.0.0.1".to_owned()]), ("client", "alice", vec![])]
        {
            let key = KeyPair::generate()?;
            let mut params = CertificateParams::new(hosts)?;
            params.distinguished_name.push(DnType::CommonName, common_name);
            self.write(&format!("{file}.pem"), &params.signed_by(&key, &authority)?.pem())?;
            self.write(&format!("{file}-key.pem"), &key.serialize_pem())?;
        }
        Ok(())
    }
}

/// Returns the setting or brace after a line's `//`, or `None` if there is none or the comment is prose.
fn commented_setting(line: &str) -> Option<&str> {
    let setting = line.trim_start().strip_prefix("//")?.trim_start();
    let key = setting.split_once(':').map_or("", |(key, _)| key);
    let is_setting = !key.is_empty() && key.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_');
    (is_setting || setting.starts_with('}')).then_some(setting)
}
