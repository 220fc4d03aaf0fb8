//! The states of all members for many robots, in SIMD registers.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]

use rayon::prelude::*;
use twinstep_model::NUM_JOINTS;
use twinstep_simd::{InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32};

use crate::ensemble::Ensemble;
use crate::kernel::{Heads, Kernel, KernelState, PATTERNS, Pair, agreement};

/// Minimum number of blocks per parallel task.
const BLOCKS_A_THREAD: usize = 8;

/// Member, and slot of a robot in this member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemberSlot {
    pub member: usize,
    pub slot: usize,
}

/// The members of an ensemble behind one trait, so that the register type can be chosen at run time.
pub trait MemberBatch: Send {
    /// Enlarges a member to `slots` robots. New states are zero; existing states do not change.
    fn grow(&mut self, member: usize, slots: usize);
    /// Sets the next input of a robot: normalised ξ of each joint, and whether its output is needed.
    fn push_input(&mut self, slot: MemberSlot, errors: &[[f32; 2]; NUM_JOINTS], output_needed: bool);
    /// Advances every robot that received an input, and evaluates the heads of those whose output is needed.
    ///
    /// Runs on the current rayon pool, if any.
    fn advance(&mut self, heads: Heads);
    /// Evaluates both heads of every member for all its robots, without advancing them.
    fn evaluate_all(&mut self);
    /// Returns the last output for a robot: normalised means and variances.
    fn output(&self, slot: MemberSlot) -> [[f32; NUM_JOINTS]; 2];
    /// Writes the epistemic uncertainty of the first robots' last outputs into `found`, mean over the joints [nat].
    ///
    /// A robot must have the same slot in every member. Variances are multiplied by `variance_scale`.
    fn disagreement(&self, variance_scale: f32, found: &mut [f32]);
    /// Returns the state of a member for a robot.
    fn state(&self, slot: MemberSlot) -> Vec<f32>;
    /// Sets the state of a member for a robot.
    fn set_state(&mut self, slot: MemberSlot, state: &[f32]);
    /// Sets the state of a member for a robot to zero.
    fn reset_state(&mut self, slot: MemberSlot);
}

/// Creates the members of `ensemble`, without robots, for an instruction set.
pub fn member_batch(ensemble: &Ensemble, instructions: InstructionSet) -> Box<dyn MemberBatch> {
    with_f32(instructions, MakeMembers(ensemble))
}

struct MakeMembers<'a>(&'a Ensemble);

impl SimdTask for MakeMembers<'_> {
    type Output = Box<dyn MemberBatch>;

    fn run<T: SimdFloat>(self) -> Self::Output {
        Box::new(Members::<T>::new(self.0))
    }
}

/// Computations for a block.
#[derive(Clone, Copy)]
struct Work {
    advance: bool,
    heads: Option<Heads>,
}

struct Members<T> {
    hidden: usize,
    members: Vec<(Kernel<T>, Vec<KernelState<T>>)>,
}

impl<T: SimdFloat> Members<T> {
    const LANES: usize = 2 * T::LANES;

    fn new(ensemble: &Ensemble) -> Self {
        let model = &ensemble.description;
        let members = ensemble.members.iter().map(|weights| (Kernel::new(model, weights), Vec::new()));
        Self { hidden: model.hidden, members: members.collect() }
    }

    /// Returns block, half and lane of each joint of a robot.
    fn lanes(slot: usize) -> impl Iterator<Item = [usize; 3]> {
        let first = slot * NUM_JOINTS;
        (first..first + NUM_JOINTS).map(|lane| [lane / Self::LANES, lane % Self::LANES / T::LANES, lane % T::LANES])
    }

    /// Runs the computations that `work` returns for each block.
    fn work(&mut self, work: impl Fn(&KernelState<T>) -> Option<Work>) {
        let Self { hidden, members } = self;
        let run = |gates: &mut Vec<[Pair<T>; 4]>,
                   (kernel, pattern, state, work): (&Kernel<T>, usize, &mut KernelState<T>, Work)| {
            T::vectorise(RunKernel { kernel, state, pattern, work, gates });
        };
        let blocks = members.iter_mut().flat_map(|(kernel, blocks)| {
            let kernel = &*kernel;
            blocks.iter_mut().enumerate().filter_map({
                let work = &work;
                move |(index, block)| work(block).map(|work| (kernel, index % PATTERNS, block, work))
            })
        });
        let room = || vec![[[T::splat(0.0); 2]; 4]; *hidden];
        if rayon::current_thread_index().is_some() && rayon::current_num_threads() > 1 {
            let blocks: Vec<_> = blocks.collect();
            blocks.into_par_iter().with_min_len(BLOCKS_A_THREAD).for_each_init(room, run);
        } else {
            let mut room = room();
            blocks.for_each(|block| run(&mut room, block));
        }
    }
}

impl<T: SimdFloat> MemberBatch for Members<T> {
    fn grow(&mut self, member: usize, slots: usize) {
        let (_, blocks) = &mut self.members[member];
        let num_blocks = (slots * NUM_JOINTS).div_ceil(Self::LANES).max(blocks.len());
        blocks.resize(num_blocks, KernelState::new(self.hidden));
    }

    fn push_input(&mut self, slot: MemberSlot, errors: &[[f32; 2]; NUM_JOINTS], output_needed: bool) {
        let (_, blocks) = &mut self.members[slot.member];
        for ([block, half, lane], errors) in Self::lanes(slot.slot).zip(errors) {
            let block = &mut blocks[block];
            for (entry, error) in errors.iter().enumerate() {
                block.input[entry][half].set(lane, f64::from(*error));
            }
            block.active[half].set(lane, 1.0);
            block.has_input = true;
            block.output_needed |= output_needed;
        }
    }

    fn advance(&mut self, heads: Heads) {
        self.work(|block| {
            block
                .has_input
                .then_some(Work { advance: true, heads: if block.output_needed { Some(heads) } else { None } })
        });
        for block in self.members.iter_mut().flat_map(|(_, blocks)| blocks).filter(|block| block.has_input) {
            (block.has_input, block.output_needed, block.active) = (false, false, [T::splat(0.0); 2]);
        }
    }

    fn evaluate_all(&mut self) {
        self.work(|_| Some(Work { advance: false, heads: Some(Heads::Both) }));
    }

    fn output(&self, slot: MemberSlot) -> [[f32; NUM_JOINTS]; 2] {
        let (_, blocks) = &self.members[slot.member];
        let mut answer = [[0.0; NUM_JOINTS]; 2];
        for (joint, [block, half, lane]) in Self::lanes(slot.slot).enumerate() {
            for (given, answer) in blocks[block].output.iter().zip(&mut answer) {
                answer[joint] = given[half].get(lane) as f32;
            }
        }
        answer
    }

    fn disagreement(&self, variance_scale: f32, found: &mut [f32]) {
        // The product over the joints of a robot cannot underflow: for 64 members it is at least 1e-22.
        let mut products = vec![1.0; found.len()];
        let mut outputs = Vec::with_capacity(self.members.len());
        for block in 0..(found.len() * NUM_JOINTS).div_ceil(Self::LANES) {
            for half in 0..2 {
                outputs.clear();
                outputs.extend(self.members.iter().map(|(_, blocks)| blocks[block].output.map(|answer| answer[half])));
                let agreement = T::vectorise(Agreement { outputs: &mut outputs, variance_scale });
                let first = block * Self::LANES + half * T::LANES;
                for lane in 0..T::LANES {
                    if let Some(product) = products.get_mut((first + lane) / NUM_JOINTS) {
                        *product *= agreement.get(lane);
                    }
                }
            }
        }
        for (found, product) in found.iter_mut().zip(products) {
            *found = ((0.0 - product.ln()) / NUM_JOINTS as f64) as f32;
        }
    }

    fn state(&self, slot: MemberSlot) -> Vec<f32> {
        let (_, blocks) = &self.members[slot.member];
        let mut state = Vec::with_capacity(2 * (1 + self.hidden) * NUM_JOINTS);
        for [block, half, lane] in Self::lanes(slot.slot) {
            let KernelState { input: inputs, cells, .. } = &blocks[block];
            state.extend(inputs.iter().chain(cells).map(|pair| pair[half].get(lane) as f32));
        }
        state
    }

    fn set_state(&mut self, slot: MemberSlot, state: &[f32]) {
        let (_, blocks) = &mut self.members[slot.member];
        let mut state = state.iter();
        for [block, half, lane] in Self::lanes(slot.slot) {
            let KernelState { input: inputs, cells, .. } = &mut blocks[block];
            for (pair, value) in inputs.iter_mut().chain(cells).zip(&mut state) {
                pair[half].set(lane, f64::from(*value));
            }
        }
    }

    fn reset_state(&mut self, slot: MemberSlot) {
        let zeros = vec![0.0; 2 * (1 + self.hidden) * NUM_JOINTS];
        self.set_state(slot, &zeros);
    }
}

/// Runs a member on one block of joints.
struct RunKernel<'a, T> {
    kernel: &'a Kernel<T>,
    state: &'a mut KernelState<T>,
    pattern: usize,
    work: Work,
    /// Workspace for the gates of each unit.
    gates: &'a mut [[Pair<T>; 4]],
}

impl<T: SimdFloat> SimdKernel for RunKernel<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        if self.work.advance {
            self.kernel.advance(self.state, self.pattern, self.gates);
        }
        if let Some(heads) = self.work.heads {
            self.kernel.answer(self.state, heads);
        }
    }
}

/// See [`agreement`].
struct Agreement<'a, T> {
    outputs: &'a mut [[T; 2]],
    variance_scale: f32,
}

impl<T: SimdFloat> SimdKernel for Agreement<'_, T> {
    type Output = T;

    #[inline(always)]
    fn run(self) -> T {
        agreement(self.outputs, self.variance_scale)
    }
}
