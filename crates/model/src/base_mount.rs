//! Mount of the base: fixed or floating.

use serde::{Deserialize, Serialize};

/// Mount of the base.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BaseMount {
    /// The base is fixed in the world, for example on a stand.
    Fixed,
    /// The base moves freely.
    Floating,
}

impl BaseMount {
    /// Returns true if the base is fixed.
    pub fn is_fixed(self) -> bool {
        self == BaseMount::Fixed
    }
}

impl std::str::FromStr for BaseMount {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "fixed" => Ok(BaseMount::Fixed),
            "floating" => Ok(BaseMount::Floating),
            _ => Err("possible: fixed, floating"),
        }
    }
}
