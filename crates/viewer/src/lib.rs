//! Robots in the browser: a local web server with one page, and what it shows.
//!
//! - [`Hub`]: between a program and its pages. The program publishes frames and takes the requests of the pages.
//! - [`SceneInfo`]: what stays the same: shapes, ground, and which controls the page has. [`Frame`]: what moves.
//! - [`WatchedVecEnv`]: environments whose robots are seen while an agent steps them.
//! - [`static_page`]: one file with the page and its frames, which needs no program.
//! - [`write_mcap`]: the same frames as MCAP, for Foxglove.
//! - [`WebServer`]: serves the page, frames as one endless response, and the page's requests.
//!
//! A frame that no page asks for is not made, and a page that reads slowly misses frames: it never delays the program.
//! The page is plain JavaScript with three.js in `web/`; nothing is loaded from elsewhere.

mod foxglove;
mod frame;
mod hub;
mod static_page;
mod watched_env;
mod web_server;

pub use foxglove::write_mcap;
pub use frame::{Frame, LearningPoint, Playback, RobotFrame, SceneInfo};
pub use hub::{Hub, PageRequest};
pub use static_page::static_page;
pub use watched_env::{MAX_ROBOTS, WatchedVecEnv};
pub use web_server::{ViewError, WebServer};
