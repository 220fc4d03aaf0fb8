//! Time of the equations of one step of the Go2: of any tree, beside those that know its shape.
//!
//! `cargo run --release -p twinstep-dynamics --example step_time`

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]

use std::hint::black_box;
use std::time::Instant;

use twinstep_dynamics::{FactoredTree, TreeLoad, TreeMotion, TreeParameters, TreeState, TreeStructure};
use twinstep_model::dynamics::{FactoredDynamics, JointLoad, KinematicTree, State};
use twinstep_model::{RobotTree, go2};
use twinstep_simd::{InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32};

const STEPS: usize = 20_000;
const ROUNDS: usize = 9;

struct Any<'a, T> {
    structure: &'a TreeStructure,
    parameters: &'a TreeParameters<T>,
    state: &'a TreeState<T>,
    load: &'a TreeLoad<T>,
    motion: &'a mut TreeMotion<T>,
    factored: &'a mut FactoredTree<T>,
    joints: &'a mut [T],
}

impl<T: SimdFloat> SimdKernel for Any<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let dt = T::splat(0.001);
        self.motion.set(self.structure, self.parameters, self.state);
        self.factored.set_up(self.structure, self.parameters, self.motion, self.state, self.load, dt);
        black_box(self.factored.solution(self.structure, self.joints));
    }
}

struct Known<'a, T> {
    tree: &'a KinematicTree<T>,
    state: &'a State<T>,
    load: &'a JointLoad<T>,
    factored: &'a mut FactoredDynamics<T>,
}

impl<T: SimdFloat> SimdKernel for Known<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (dt, gravity, one) = (T::splat(0.001), T::splat(9.81), T::splat(1.0));
        self.factored.set_up(self.tree, self.state, self.load, dt, gravity, one);
        black_box(self.factored.solution());
    }
}

struct Compare;

impl SimdTask for Compare {
    type Output = ();

    fn run<T: SimdFloat>(self) {
        let robot = RobotTree::from(&go2());
        let structure = TreeStructure::new(&robot);
        let parameters = TreeParameters::<T>::splat(&robot);
        let zero = T::splat(0.0);
        let mut state = TreeState::<T>::origin(12);
        for (q, value) in state.q.iter_mut().zip(go2().control.default_pose) {
            *q = T::splat(value);
        }
        let load = TreeLoad { gravity: T::splat(9.81), tau: vec![zero; 12], damping: vec![zero; 12] };
        let mut motion = TreeMotion::empty(&structure, &parameters);
        let mut factored = FactoredTree::empty(&structure, &parameters);
        let mut joints = vec![zero; 12];
        let own_tree = KinematicTree::<T>::splat(&go2());
        let own_state = State { q: go2().control.default_pose.map(T::splat), ..State::origin() };
        let own_load = JointLoad { tau: [zero; 12], damping: [zero; 12] };
        let mut own_factored = FactoredDynamics::empty();
        let (mut any, mut known) = (Vec::new(), Vec::new());
        for _ in 0..ROUNDS {
            let start = Instant::now();
            for _ in 0..STEPS {
                T::vectorise(Any {
                    structure: &structure,
                    parameters: &parameters,
                    state: black_box(&state),
                    load: &load,
                    motion: &mut motion,
                    factored: &mut factored,
                    joints: &mut joints,
                });
            }
            any.push(start.elapsed().as_secs_f64() / STEPS as f64);
            let start = Instant::now();
            for _ in 0..STEPS {
                let (state, factored) = (black_box(&own_state), &mut own_factored);
                T::vectorise(Known { tree: &own_tree, state, load: &own_load, factored });
            }
            known.push(start.elapsed().as_secs_f64() / STEPS as f64);
        }
        let median = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            1e9 * times[ROUNDS / 2]
        };
        let (any, known) = (median(&mut any), median(&mut known));
        println!("{} lanes: any tree {any:.0} ns, tree of the Go2 {known:.0} ns, ratio {:.2}", T::LANES, any / known);
    }
}

fn main() {
    with_f32(InstructionSet::best(), Compare);
}
