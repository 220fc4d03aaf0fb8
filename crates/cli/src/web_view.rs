//! Options and start of a browser view: `--view` of `serve`, `train`, `run` and `robot`, and `twinstep view`.

use std::net::SocketAddr;
use std::sync::Arc;

use twinstep_env_server::{EnvFactory, EnvFactoryError};
use twinstep_model::{AutoresetMode, PerJoint, ResetRequest, VecEnv};
use twinstep_protocol::message::RealTime;
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
    /// Word without which the page is not shown. Needed at an address that others can reach.
    #[arg(long, value_name = "WORD", requires = "view")]
    view_token: Option<String>,
}

/// Options of `twinstep view` for its page.
#[derive(clap::Args)]
pub struct PageArgs {
    /// Address of the page; port 0 selects a free port. One that others can reach needs --token.
    #[arg(long, value_name = "ADDRESS", default_value = DEFAULT_ADDRESS)]
    listen: SocketAddr,
    /// Word without which the page is not shown.
    #[arg(long, value_name = "WORD")]
    token: Option<String>,
}

impl PageArgs {
    /// Serves a page and says where it is.
    pub fn open(&self, scene: SceneInfo) -> Result<Page, Failure> {
        Page::open(self.listen, self.token.clone(), Arc::new(Hub::new(scene)))
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
        let page = Self { view: DEFAULT_ADDRESS.parse().ok(), view_token: None };
        if page.check().is_ok() { page } else { Self::default() }
    }

    /// Serves the page of robots like that of `env`, which learn, if there is to be one. `env` is reset.
    pub fn open(&self, title: &str, env: &mut dyn VecEnv, torque_limits: PerJoint) -> Result<Option<Page>, Failure> {
        if !self.is_wanted() {
            return Ok(None);
        }
        env.reset(&ResetRequest::default()).map_err(other)?;
        let scene = SceneInfo::new(title, &env.scene(0).map_err(other)?, torque_limits);
        let scene = SceneInfo { is_learning: true, ..scene }.with_reward_terms(&env.spec().reward_terms);
        self.serve(&Arc::new(Hub::new(scene)))
    }

    /// Serves a page of what `hub` shows, if there is to be one.
    pub fn serve(&self, hub: &Arc<Hub>) -> Result<Option<Page>, Failure> {
        self.view.map(|address| Page::open(address, self.view_token.clone(), Arc::clone(hub))).transpose()
    }

    /// Checks that the page can be served.
    pub fn check(&self) -> Result<(), Failure> {
        self.view.map_or(Ok(()), |address| WebServer::check(address, self.view_token.as_deref()).map_err(input))
    }

    /// Returns true if there is to be a page.
    pub fn is_wanted(&self) -> bool {
        self.view.is_some()
    }
}

impl Page {
    fn open(address: SocketAddr, token: Option<String>, hub: Arc<Hub>) -> Result<Self, Failure> {
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
