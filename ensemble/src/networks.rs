//! All members with what they remember of many robots, in the processor's widest registers.

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]

use rayon::prelude::*;
use twinstep_model::NUM_JOINTS;
use twinstep_model::lanes::InstructionSet;

use crate::ensemble::Ensemble;
use crate::kernel::{KernelState, Heads, Kernel, PATTERNS, Pair, agreement};
#[cfg(target_arch = "x86_64")]
use crate::wide::{Avx2, Avx512};
use crate::wide::{Portable, Wide};

/// Blocks that a thread takes at a time.
const BLOCKS_A_THREAD: usize = 8;

/// Where a member keeps a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemberSlot {
    pub member: usize,
    pub slot: usize,
}

/// Members below one seam: which registers run is chosen when they are made.
pub trait MemberBatch: Send {
    /// Gives a member room for so many robots, from states of zero; what it has stays.
    fn grow(&mut self, member: usize, slots: usize);
    /// The next row of a robot's joints, ξ normalised; `asked` if an answer is wanted.
    fn push_input(&mut self, place: MemberSlot, errors: &[[f32; 2]; NUM_JOINTS], asked: bool);
    /// Advances every robot that was heard of, and answers for those that are asked, on the threads of the pool that this
    /// is called in; outside of one on this thread.
    fn advance(&mut self, heads: Heads);
    /// Lets every member answer for all its robots, as they are.
    fn evaluate_all(&mut self);
    /// The last answer for a robot: means, variances, normalised.
    fn output(&self, place: MemberSlot) -> [[f32; NUM_JOINTS]; 2];
    /// The mean over the first robots' joints of how much all members' last answers disagree; every member has every robot
    /// in the same slot. Variances are multiplied by `variance_scale`.
    fn disagreement(&self, variance_scale: f32, found: &mut [f32]);
    /// Everything that a member remembers of a robot.
    fn state(&self, place: MemberSlot) -> Vec<f32>;
    /// Puts that back.
    fn set_state(&mut self, place: MemberSlot, memory: &[f32]);
    /// A robot whose past is unseen.
    fn reset_state(&mut self, place: MemberSlot);
}

/// The members of `ensemble` without a robot.
///
/// # Panics
/// If the processor lacks `instructions`.
pub fn networks(ensemble: &Ensemble, instructions: InstructionSet) -> Box<dyn MemberBatch> {
    assert!(InstructionSet::available().contains(&instructions), "this processor has no {instructions:?}");
    match instructions {
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx512 => Box::new(Members::<Avx512>::new(ensemble, run_avx512, agree_avx512)),
        // AVX2 without fused operations is too rare for a path of its own.
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx2 if is_x86_feature_detected!("fma") => {
            Box::new(Members::<Avx2>::new(ensemble, run_avx2, agree_avx2))
        }
        _ => Box::new(Members::<Portable>::new(ensemble, run, agreement)),
    }
}

/// Runs a block of a pattern; the last argument is room for its gates.
type RunBlockFn<W> = fn(&Kernel<W>, &mut KernelState<W>, usize, Work, &mut [[Pair<W>; 4]]);
type Agree<W> = fn(&mut [[W; 2]], f32) -> W;

/// What is to be done with a block.
#[derive(Clone, Copy)]
struct Work {
    advance: bool,
    heads: Option<Heads>,
}

struct Members<W> {
    hidden: usize,
    members: Vec<(Kernel<W>, Vec<KernelState<W>>)>,
    run: RunBlockFn<W>,
    agree: Agree<W>,
}

impl<W: Wide> Members<W> {
    const LANES: usize = 2 * W::LANES;

    fn new(ensemble: &Ensemble, run: RunBlockFn<W>, agree: Agree<W>) -> Self {
        let model = &ensemble.description;
        let members = ensemble.members.iter().map(|weights| (Kernel::new(model, weights), Vec::new()));
        Self { hidden: model.hidden, members: members.collect(), run, agree }
    }

    /// Block, half and lane of a robot's joints.
    fn lanes(slot: usize) -> impl Iterator<Item = [usize; 3]> {
        let first = slot * NUM_JOINTS;
        (first..first + NUM_JOINTS).map(|lane| [lane / Self::LANES, lane % Self::LANES / W::LANES, lane % W::LANES])
    }

    /// Runs the blocks for which there is work.
    fn work(&mut self, work: impl Fn(&KernelState<W>) -> Option<Work>) {
        let Self { hidden, members, run, .. } = self;
        let run = |room: &mut Vec<[Pair<W>; 4]>,
                   (kernel, pattern, block, work): (&Kernel<W>, usize, &mut KernelState<W>, Work)| {
            run(kernel, block, pattern, work, room);
        };
        let blocks = members.iter_mut().flat_map(|(kernel, blocks)| {
            let kernel = &*kernel;
            blocks.iter_mut().enumerate().filter_map({
                let work = &work;
                move |(index, block)| work(block).map(|work| (kernel, index % PATTERNS, block, work))
            })
        });
        let room = || vec![[[W::splat(0.0); 2]; 4]; *hidden];
        if rayon::current_thread_index().is_some() && rayon::current_num_threads() > 1 {
            let blocks: Vec<_> = blocks.collect();
            blocks.into_par_iter().with_min_len(BLOCKS_A_THREAD).for_each_init(room, run);
        } else {
            let mut room = room();
            blocks.for_each(|block| run(&mut room, block));
        }
    }
}

impl<W: Wide> MemberBatch for Members<W> {
    fn grow(&mut self, member: usize, slots: usize) {
        let (_, blocks) = &mut self.members[member];
        let wanted = (slots * NUM_JOINTS).div_ceil(Self::LANES).max(blocks.len());
        blocks.resize(wanted, KernelState::new(self.hidden));
    }

    fn push_input(&mut self, place: MemberSlot, errors: &[[f32; 2]; NUM_JOINTS], asked: bool) {
        let (_, blocks) = &mut self.members[place.member];
        for ([block, half, lane], errors) in Self::lanes(place.slot).zip(errors) {
            let block = &mut blocks[block];
            for (entry, error) in errors.iter().enumerate() {
                block.input[entry][half].set(lane, *error);
            }
            block.active[half].set(lane, 1.0);
            block.has_input = true;
            block.output_needed |= asked;
        }
    }

    fn advance(&mut self, heads: Heads) {
        self.work(|block| {
            block.has_input.then_some(Work { advance: true, heads: if block.output_needed { Some(heads) } else { None } })
        });
        for block in self.members.iter_mut().flat_map(|(_, blocks)| blocks).filter(|block| block.has_input) {
            (block.has_input, block.output_needed, block.active) = (false, false, [W::splat(0.0); 2]);
        }
    }

    fn evaluate_all(&mut self) {
        self.work(|_| Some(Work { advance: false, heads: Some(Heads::Both) }));
    }

    fn output(&self, place: MemberSlot) -> [[f32; NUM_JOINTS]; 2] {
        let (_, blocks) = &self.members[place.member];
        let mut answer = [[0.0; NUM_JOINTS]; 2];
        for (joint, [block, half, lane]) in Self::lanes(place.slot).enumerate() {
            for (given, answer) in blocks[block].output.iter().zip(&mut answer) {
                answer[joint] = given[half].get(lane);
            }
        }
        answer
    }

    fn disagreement(&self, variance_scale: f32, found: &mut [f32]) {
        // A product of whole numbers of robots: twelve agreements of 64 members are no less than 1e-22.
        let mut products = vec![1.0; found.len()];
        let mut answers = Vec::with_capacity(self.members.len());
        for block in 0..(found.len() * NUM_JOINTS).div_ceil(Self::LANES) {
            for half in 0..2 {
                answers.clear();
                answers.extend(self.members.iter().map(|(_, blocks)| blocks[block].output.map(|answer| answer[half])));
                let agreement = (self.agree)(&mut answers, variance_scale);
                let first = block * Self::LANES + half * W::LANES;
                for lane in 0..W::LANES {
                    if let Some(product) = products.get_mut((first + lane) / NUM_JOINTS) {
                        *product *= f64::from(agreement.get(lane));
                    }
                }
            }
        }
        for (found, product) in found.iter_mut().zip(products) {
            *found = ((0.0 - product.ln()) / NUM_JOINTS as f64) as f32;
        }
    }

    fn state(&self, place: MemberSlot) -> Vec<f32> {
        let (_, blocks) = &self.members[place.member];
        let mut memory = Vec::with_capacity(2 * (1 + self.hidden) * NUM_JOINTS);
        for [block, half, lane] in Self::lanes(place.slot) {
            let KernelState { input: heard, cells, .. } = &blocks[block];
            memory.extend(heard.iter().chain(cells).map(|pair| pair[half].get(lane)));
        }
        memory
    }

    fn set_state(&mut self, place: MemberSlot, memory: &[f32]) {
        let (_, blocks) = &mut self.members[place.member];
        let mut memory = memory.iter();
        for [block, half, lane] in Self::lanes(place.slot) {
            let KernelState { input: heard, cells, .. } = &mut blocks[block];
            for (pair, value) in heard.iter_mut().chain(cells).zip(&mut memory) {
                pair[half].set(lane, *value);
            }
        }
    }

    fn reset_state(&mut self, place: MemberSlot) {
        let nothing = vec![0.0; 2 * (1 + self.hidden) * NUM_JOINTS];
        self.set_state(place, &nothing);
    }
}

#[inline(always)]
fn run<W: Wide>(kernel: &Kernel<W>, block: &mut KernelState<W>, pattern: usize, work: Work, room: &mut [[Pair<W>; 4]]) {
    if work.advance {
        kernel.advance(block, pattern, room);
    }
    if let Some(heads) = work.heads {
        kernel.answer(block, heads);
    }
}

/// The same for registers that only some processors have.
macro_rules! entries {
    ($wide:ty, $feature:literal, $run:ident, $enter_run:ident, $agree:ident, $enter_agree:ident) => {
        #[cfg(target_arch = "x86_64")]
        fn $run(
            kernel: &Kernel<$wide>,
            block: &mut Block<$wide>,
            pattern: usize,
            work: Work,
            room: &mut [[Pair<$wide>; 4]],
        ) {
            // SAFETY: `networks` has made sure that the processor has them.
            #[allow(unsafe_code)]
            unsafe {
                $enter_run(kernel, block, pattern, work, room);
            }
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $feature)]
        fn $enter_run(
            kernel: &Kernel<$wide>,
            block: &mut Block<$wide>,
            pattern: usize,
            work: Work,
            room: &mut [[Pair<$wide>; 4]],
        ) {
            run(kernel, block, pattern, work, room);
        }

        #[cfg(target_arch = "x86_64")]
        fn $agree(answers: &mut [[$wide; 2]], variance_scale: f32) -> $wide {
            // SAFETY: `networks` has made sure that the processor has them.
            #[allow(unsafe_code)]
            unsafe {
                $enter_agree(answers, variance_scale)
            }
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $feature)]
        fn $enter_agree(answers: &mut [[$wide; 2]], variance_scale: f32) -> $wide {
            agreement(answers, variance_scale)
        }
    };
}

entries!(Avx512, "avx512f", run_avx512, enter_run_avx512, agree_avx512, enter_agree_avx512);
entries!(Avx2, "avx2,fma", run_avx2, enter_run_avx2, agree_avx2, enter_agree_avx2);
