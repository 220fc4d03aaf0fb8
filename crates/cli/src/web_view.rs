//! Options and start of a browser view: `--view` of `serve`, `train`, `run` and `robot`, and `twinstep view`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use twinstep_env_server::{EnvFactory, EnvFactoryError};
use twinstep_model::{AutoresetMode, ResetRequest, Scene, VecEnv};
use twinstep_protocol::message::RealTime;
use twinstep_protocol::random_id;
use twinstep_viewer::{Hub, SceneInfo, WatchedVecEnv, WebServer};

use crate::exit::{Failure, input, other};

/// Where the page is, if no address is given.
const DEFAULT_ADDRESS: &str = "127.0.0.1:7480";

/// Options of commands whose robots can be looked at.
#[derive(Default, clap::Args)]
pub struct ViewArgs {
    /// Show the robots in the browser at this address, up to 64 of them. Over ssh:
    /// `ssh -L 7480:localhost:7480 HOST`. Default address: 127.0.0.1:7480.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = DEFAULT_ADDRESS)]
    view: Option<SocketAddr>,
    /// File with the word without which the page is not shown. Default at an address that others can reach: a random word,
    /// which is part of the printed address.
    #[arg(long, value_name = "FILE", requires = "view")]
    view_token_file: Option<PathBuf>,
}

/// Options of `twinstep view` for its page.
#[derive(clap::Args)]
pub struct PageArgs {
    /// Address of the page; port 0 selects a free port. One that others can reach has a token.
    #[arg(long, value_name = "ADDRESS", default_value = DEFAULT_ADDRESS)]
    listen: SocketAddr,
    /// File with the word without which the page is not shown. Default at an address that others can reach: a random word,
    /// which is part of the printed address.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

impl PageArgs {
    /// Serves a page and says where it is.
    pub fn open(&self, scene: SceneInfo) -> Result<Page, Failure> {
        Page::open(self.listen, self.token_file.as_deref(), Arc::new(Hub::new(scene)))
    }
}

/// A page that is served until the value is dropped.
pub struct Page {
    hub: Arc<Hub>,
    _server: WebServer,
}

impl ViewArgs {
    /// Returns the options of a page at the default address; without a page if it cannot be served there.
    pub fn default_page() -> Self {
        let page = Self { view: DEFAULT_ADDRESS.parse().ok(), view_token_file: None };
        if page.check().is_ok() { page } else { Self::default() }
    }

    /// Serves the page of robots like that of `env`, which learn, if there is to be one. `env` is reset.
    pub fn open(&self, env: &mut dyn VecEnv, info: impl FnOnce(&Scene) -> SceneInfo) -> Result<Option<Page>, Failure> {
        if !self.is_wanted() {
            return Ok(None);
        }
        env.reset(&ResetRequest::default()).map_err(other)?;
        let scene = info(&env.scene(0).map_err(other)?);
        let scene = SceneInfo { is_learning: true, ..scene }.with_reward_terms(&env.spec().reward_terms);
        self.serve(&Arc::new(Hub::new(scene)))
    }

    /// Serves a page of what `hub` shows, if there is to be one.
    pub fn serve(&self, hub: &Arc<Hub>) -> Result<Option<Page>, Failure> {
        self.view.map(|address| Page::open(address, self.view_token_file.as_deref(), Arc::clone(hub))).transpose()
    }

    /// Checks that the page can be served.
    pub fn check(&self) -> Result<(), Failure> {
        let Some(address) = self.view else { return Ok(()) };
        WebServer::check(address, token(address, self.view_token_file.as_deref())?.as_deref()).map_err(input)
    }

    /// Returns true if there is to be a page.
    pub fn is_wanted(&self) -> bool {
        self.view.is_some()
    }
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

/// Builds environments that a hub shows. With several leases it shows the newest one.
pub struct WatchedFactory<F> {
    /// Builds the environments.
    pub factory: F,
    /// What is shown.
    pub hub: Arc<Hub>,
}

impl<F: EnvFactory> EnvFactory for WatchedFactory<F> {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let env = self.factory.build(num_envs, autoreset, max_episode_steps)?;
        Ok(Box::new(WatchedVecEnv::new(env, Arc::clone(&self.hub))))
    }

    fn real_time(&self) -> Option<RealTime> {
        self.factory.real_time()
    }

    fn stop(&self) -> bool {
        self.factory.stop()
    }
}
