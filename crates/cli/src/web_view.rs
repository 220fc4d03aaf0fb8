//! Options and start of a browser view: `--view` of `serve`, `train`, `run` and `robot`, and `twinstep view`.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use twinstep_env_server::{EnvFactory, EnvFactoryError};
use twinstep_model::{AutoresetMode, VecEnv};
use twinstep_protocol::message::RealTime;
use twinstep_viewer::{Hub, SceneInfo, WatchedVecEnv};
use twinstep_workflows::web_page::{Page, PageOptions};

use crate::exit::Failure;

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
        let page = PageOptions { address: self.listen, token_file: self.token_file.clone() };
        page.serve(&Arc::new(Hub::new(scene)))
    }
}

impl ViewArgs {
    /// Returns the options of a page at the default address; without a page if it cannot be served there.
    pub fn default_page() -> Option<PageOptions> {
        let page = PageOptions { address: DEFAULT_ADDRESS.parse().ok()?, token_file: None };
        page.check().is_ok().then_some(page)
    }

    /// Returns the options of the page, if there is to be one.
    pub fn options(&self) -> Option<PageOptions> {
        self.view.map(|address| PageOptions { address, token_file: self.view_token_file.clone() })
    }

    /// Serves a page of what `hub` shows, if there is to be one.
    pub fn serve(&self, hub: &Arc<Hub>) -> Result<Option<Page>, Failure> {
        self.options().map(|page| page.serve(hub)).transpose()
    }

    /// Checks that the page can be served.
    pub fn check(&self) -> Result<(), Failure> {
        self.options().map_or(Ok(()), |page| page.check())
    }

    /// Returns true if there is to be a page.
    pub fn is_wanted(&self) -> bool {
        self.view.is_some()
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
