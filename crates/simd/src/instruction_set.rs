//! The instruction sets that the processor has.

use std::sync::OnceLock;

/// Environment variable that selects an instruction set by its name in lower case.
const VARIABLE: &str = "TWINSTEP_SIMD";

/// An instruction set that this processor has; the value is the proof.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct InstructionSet(pub(crate) Level);

/// Instruction sets that there are registers for, from the slowest to the fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    /// Arrays of four numbers, for which the compiler chooses the instructions: every architecture.
    Portable,
    /// SSE2: 128-bit registers that every x86-64 processor has.
    #[cfg(target_arch = "x86_64")]
    Sse2,
    /// AVX2 with fused multiplication and addition: 256-bit registers of x86-64.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512F: 512-bit registers of x86-64.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// `TWINSTEP_SIMD` names no instruction set of this processor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownInstructionSet {
    /// The value of the variable.
    pub value: String,
}

impl std::fmt::Display for UnknownInstructionSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<_> = InstructionSet::available().iter().map(|set| set.name()).collect();
        write!(f, "`{VARIABLE}` = {:?} is not allowed: this processor has {}", self.value, names.join(", "))
    }
}

impl std::error::Error for UnknownInstructionSet {}

impl InstructionSet {
    /// The registers of every architecture.
    pub const PORTABLE: Self = Self(Level::Portable);

    /// Returns the instruction sets of this processor, from the slowest to the fastest.
    pub fn available() -> Vec<Self> {
        let detected = [
            #[cfg(target_arch = "x86_64")]
            Some(Self(Level::Sse2)),
            #[cfg(target_arch = "x86_64")]
            (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(Level::Avx2)),
            #[cfg(target_arch = "x86_64")]
            is_x86_feature_detected!("avx512f").then_some(Self(Level::Avx512)),
        ];
        std::iter::once(Self::PORTABLE).chain(detected.into_iter().flatten()).collect()
    }

    /// Returns the fastest instruction set of this processor, or the one that `TWINSTEP_SIMD` names.
    ///
    /// A wrong name is ignored here; programs report it ([`InstructionSet::from_environment`]).
    pub fn best() -> Self {
        static SELECTED: OnceLock<InstructionSet> = OnceLock::new();
        *SELECTED.get_or_init(|| {
            let selected = Self::from_environment().ok().flatten();
            selected.or_else(|| Self::available().pop()).unwrap_or(Self::PORTABLE)
        })
    }

    /// Returns the instruction set that the environment variable `TWINSTEP_SIMD` names, if it is set.
    pub fn from_environment() -> Result<Option<Self>, UnknownInstructionSet> {
        std::env::var_os(VARIABLE).map(|value| Self::named(&value.to_string_lossy())).transpose()
    }

    fn named(value: &str) -> Result<Self, UnknownInstructionSet> {
        let found = Self::available().into_iter().find(|set| set.name() == value);
        found.ok_or_else(|| UnknownInstructionSet { value: value.to_owned() })
    }

    fn name(self) -> &'static str {
        match self.0 {
            Level::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Level::Sse2 => "sse2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
        }
    }
}

impl std::fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self.0 {
            Level::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Level::Sse2 => "SSE2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "AVX-512",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instruction_sets_are_found_by_their_names() {
        for set in InstructionSet::available() {
            assert_eq!(InstructionSet::named(set.name()), Ok(set));
        }
        let error = InstructionSet::named("neon").expect_err("no such registers").to_string();
        assert!(error.starts_with("`TWINSTEP_SIMD` = \"neon\" is not allowed: this processor has portable"), "{error}");
    }
}
