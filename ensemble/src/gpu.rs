//! GPU device for training.

use burn::tensor::Device;

use crate::EnsembleError;

/// Returns the best GPU as a burn device, and its name. Software drivers are used only if there is no other.
#[cfg(feature = "gpu")]
pub fn best() -> Result<(Device, &'static str), EnsembleError> {
    match found() {
        Ok((device, name)) => Ok((device.clone(), name)),
        Err(error) => Err(EnsembleError::NoGpu { cause: error.to_string() }),
    }
}

/// Returns an error, because the feature `gpu` is off.
#[cfg(not(feature = "gpu"))]
pub fn best() -> Result<(Device, &'static str), EnsembleError> {
    Err(EnsembleError::NoGpu {
        cause: "built without GPU support; use `cargo build --release --features gpu`".to_owned(),
    })
}

/// Returns the GPU, which burn can initialise only once per process.
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

    /// Returns the GPU to test on, or `None` if there is none.
    pub fn device() -> Option<Device> {
        match found() {
            Ok((device, name)) => {
                println!("on {name}");
                Some(device.clone())
            }
            Err(WgpuInitError::AdapterUnavailable { .. }) => {
                println!("skipped: no GPU");
                None
            }
            Err(error) => panic!("cannot use the GPU: {error}"),
        }
    }
}

#[cfg(all(test, not(feature = "gpu")))]
mod tests {
    use super::*;

    #[test]
    fn error_without_the_feature_contains_the_build_command() {
        let error = best().map(|_| ()).expect_err("none").to_string();
        assert_eq!(
            error,
            "cannot train on a GPU: built without GPU support; use `cargo build --release --features gpu`"
        );
    }
}
