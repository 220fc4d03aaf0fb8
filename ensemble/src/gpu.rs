//! The GPU that a training can run on.

use burn::tensor::Device;

use crate::EnsembleError;

/// The best GPU there is as burn's device, and its name. Graphics drivers in software are the last choice.
#[cfg(feature = "gpu")]
pub fn best() -> Result<(Device, &'static str), EnsembleError> {
    match found() {
        Ok((device, name)) => Ok((device.clone(), name)),
        Err(error) => Err(EnsembleError::NoGpu { cause: error.to_string() }),
    }
}

/// Without the feature there is none.
#[cfg(not(feature = "gpu"))]
pub fn best() -> Result<(Device, &'static str), EnsembleError> {
    Err(EnsembleError::NoGpu { cause: "built without it: cargo build --release --features gpu".to_owned() })
}

/// burn takes a GPU once in a process.
#[cfg(feature = "gpu")]
fn found() -> &'static Result<(Device, String), burn::tensor::wgpu::WgpuInitError> {
    static FOUND: std::sync::OnceLock<Result<(Device, String), burn::tensor::wgpu::WgpuInitError>> =
        std::sync::OnceLock::new();
    FOUND.get_or_init(|| {
        let (device, setup) = Device::wgpu_options().init_with_setup()?;
        Ok((device, setup.adapter.get_info().name))
    })
}

#[cfg(all(test, feature = "gpu"))]
pub mod tests {
    use burn::tensor::wgpu::WgpuInitError;

    use super::*;

    /// The GPU to test on, where there is one.
    pub fn device() -> Option<Device> {
        match found() {
            Ok((device, name)) => {
                println!("on {name}");
                Some(device.clone())
            }
            Err(WgpuInitError::AdapterUnavailable { .. }) => {
                println!("skipped: no adapter");
                None
            }
            Err(error) => panic!("there is a GPU, but {error}"),
        }
    }
}

#[cfg(all(test, not(feature = "gpu")))]
mod tests {
    use super::*;

    #[test]
    fn build_without_it_says_how_to_get_one_with_it() {
        let error = best().map(|_| ()).expect_err("none").to_string();
        assert_eq!(error, "cannot train on a GPU: built without it: cargo build --release --features gpu");
    }
}
