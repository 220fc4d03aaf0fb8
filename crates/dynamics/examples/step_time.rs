//! Time of the equations of one step of the Go2: of any tree, beside those that know its shape.
//!
//! `cargo run --release -p twinstep-dynamics --example step_time`

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]

use std::hint::black_box;
use std::time::Instant;

use twinstep_dynamics::quadruped::FactoredDynamics;
use twinstep_dynamics::tree::TreeEquations;
use twinstep_dynamics::{JointForces, JointValues, State, StepEquations};
use twinstep_model::{RobotTree, TreeModel, go2};
use twinstep_simd::{InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32};

const STEPS: usize = 20_000;
const ROUNDS: usize = 9;

struct Step<'a, T: SimdFloat, E: StepEquations<T>> {
    parameters: &'a E::Parameters,
    state: &'a State<T, E::Joints>,
    forces: &'a JointForces<E::Joints>,
    equations: &'a mut E,
    joints: &'a mut E::Joints,
}

impl<T: SimdFloat, E: StepEquations<T>> SimdKernel for Step<'_, T, E> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (dt, gravity, one) = (T::splat(0.001), T::splat(9.81), T::splat(1.0));
        self.equations.set_up(self.parameters, self.state, self.forces, dt, gravity, one);
        black_box(self.equations.solution(self.joints));
    }
}

/// Returns a function that measures the time of a step [s].
fn timed<T: SimdFloat, E: StepEquations<T>>(robot: &E::Robot) -> impl FnMut() -> f64 {
    let parameters = E::parameters(robot);
    let mut state = State::<T, E::Joints>::origin(12);
    for (q, value) in state.q.as_mut().iter_mut().zip(go2().control.default_pose) {
        *q = T::splat(value);
    }
    let mut joints = E::Joints::filled(12, T::splat(0.0));
    let forces = JointForces::frictionless(joints.clone());
    let mut equations = E::empty(&parameters);
    move || {
        let start = Instant::now();
        for _ in 0..STEPS {
            T::vectorise(Step {
                parameters: &parameters,
                state: black_box(&state),
                forces: &forces,
                equations: &mut equations,
                joints: &mut joints,
            });
        }
        start.elapsed().as_secs_f64() / STEPS as f64
    }
}

struct Compare;

impl SimdTask for Compare {
    type Output = ();

    fn run<T: SimdFloat>(self) {
        let (robot, own) = (TreeModel::new(RobotTree::from(&go2())).expect("equal limits"), go2());
        let mut any = timed::<T, TreeEquations<T>>(&robot);
        let mut known = timed::<T, FactoredDynamics<T>>(&own);
        let mut times: Vec<_> = (0..ROUNDS).map(|_| [any(), known()]).collect();
        let mut median = |which: usize| {
            times.sort_by(|a, b| a[which].total_cmp(&b[which]));
            1e9 * times[ROUNDS / 2][which]
        };
        let (any, known) = (median(0), median(1));
        println!("{} lanes: any tree {any:.0} ns, tree of the Go2 {known:.0} ns, ratio {:.2}", T::LANES, any / known);
    }
}

fn main() {
    with_f32(InstructionSet::best(), Compare);
}
