//! The browser page of robots.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use twinstep_model::{ResetRequest, Scene, VecEnv};
use twinstep_protocol::random_id;
use twinstep_viewer::{Hub, SceneInfo, WatchedVecEnv, WebServer};

use crate::failure::{Failure, input, other};

/// Where a page is served.
#[derive(Clone, Debug, PartialEq)]
pub struct PageOptions {
    /// Address; port 0 selects a free port.
    pub address: SocketAddr,
    /// File with the word without which the page is not shown. Default at an address that others can reach: a random word.
    pub token_file: Option<PathBuf>,
}

impl PageOptions {
    /// Serves a page of what `hub` shows, and says where it is.
    pub fn serve(&self, hub: &Arc<Hub>) -> Result<Page, Failure> {
        Page::open(self.address, self.token_file.as_deref(), Arc::clone(hub))
    }

    /// Serves the page of robots like that of `env`, which learn. `env` is reset.
    pub fn open(&self, env: &mut dyn VecEnv, info: impl FnOnce(&Scene) -> SceneInfo) -> Result<Page, Failure> {
        env.reset(&ResetRequest::default()).map_err(other)?;
        let scene = info(&env.scene(0).map_err(other)?);
        let scene = SceneInfo { is_learning: true, ..scene }.with_reward_terms(&env.spec().reward_terms);
        self.serve(&Arc::new(Hub::new(scene)))
    }

    /// Checks that the page can be served.
    pub fn check(&self) -> Result<(), Failure> {
        let token = token(self.address, self.token_file.as_deref())?;
        WebServer::check(self.address, token.as_deref()).map_err(input)
    }
}

/// A page that is served until the value is dropped.
pub struct Page {
    hub: Arc<Hub>,
    _server: WebServer,
}

impl Page {
    fn open(address: SocketAddr, token_file: Option<&Path>, hub: Arc<Hub>) -> Result<Self, Failure> {
        let token = token(address, token_file)?;
        let server = WebServer::start(address, token, Arc::clone(&hub)).map_err(input)?;
        eprintln!("the robots are at {}", server.url());
        Ok(Self { hub, _server: server })
    }

    /// Returns what the page shows.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// Lets the page see the robots of `env`.
    pub fn watch(&self, env: Box<dyn VecEnv>) -> Box<dyn VecEnv> {
        Box::new(WatchedVecEnv::new(env, Arc::clone(&self.hub)))
    }
}

/// Returns the token of a page: that of the file, or a random one at an address that others can reach. It is not an argument
/// because every user of this machine sees those.
fn token(address: SocketAddr, file: Option<&Path>) -> Result<Option<String>, Failure> {
    match file {
        Some(file) => {
            let read = std::fs::read_to_string(file);
            let cause = |error| miette::miette!("cannot read the token file {}: {error}", file.display());
            Ok(Some(read.map_err(|error| Failure::Input(cause(error)))?.trim().to_owned()))
        }
        None => Ok((!address.ip().is_loopback()).then(|| [random_id(), random_id()].concat())),
    }
}
