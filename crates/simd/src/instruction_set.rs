//! The instruction sets that the processor has.

/// An instruction set that this processor has; the value is the proof.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct InstructionSet(pub(crate) Level);

/// Instruction sets that there are registers for, from the slowest to the fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    /// The instructions that every processor of the architecture has.
    Baseline,
    /// AVX2 with fused multiplication and addition: 256-bit registers of x86-64.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512F: 512-bit registers of x86-64.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl InstructionSet {
    /// The instruction set that every processor of the architecture has.
    pub const BASELINE: Self = Self(Level::Baseline);

    /// Returns the instruction sets of this processor, from the slowest to the fastest.
    pub fn available() -> Vec<Self> {
        let detected = [
            #[cfg(target_arch = "x86_64")]
            (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(Level::Avx2)),
            #[cfg(target_arch = "x86_64")]
            is_x86_feature_detected!("avx512f").then_some(Self(Level::Avx512)),
        ];
        std::iter::once(Self::BASELINE).chain(detected.into_iter().flatten()).collect()
    }

    /// Returns the fastest instruction set of this processor.
    pub fn best() -> Self {
        Self::available().into_iter().last().unwrap_or(Self::BASELINE)
    }
}

impl std::fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self.0 {
            Level::Baseline if cfg!(target_arch = "x86_64") => "SSE2",
            Level::Baseline => "baseline",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "AVX-512",
        })
    }
}
