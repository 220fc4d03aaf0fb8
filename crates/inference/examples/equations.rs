//! Prints what explains logs of a Go2.

use twinstep_inference::equations::explain;
use twinstep_logs::Log;
use twinstep_model::go2;

fn main() {
    for path in std::env::args().skip(1) {
        let start = std::time::Instant::now();
        let log = Log::open(&path).expect("a log");
        let mut say = |line: &str| {
            eprintln!("{:.1} s: {line}", start.elapsed().as_secs_f64());
            true
        };
        let found = match explain(&log, &go2(), &std::sync::Arc::default(), |_| true, &mut say) {
            Ok(found) => found.expect("it is not interrupted"),
            Err(error) => {
                println!("{path}: {error}");
                continue;
            }
        };
        println!("{path}: {:.1} s", start.elapsed().as_secs_f64());
        for cause in &found.causes {
            let (name, scope, gain) = (cause.effect.name, &cause.scope, cause.gain);
            println!("  {name}@{scope} {gain:.1} nat {:.4?} {:.4?}", cause.values, cause.intervals);
            for own in &cause.by_joint {
                println!("    {} {:.4?} {:.4?}", own.joint, own.values, own.intervals);
            }
        }
        println!("  left {:.3} {:?}, gains {:.3?}", found.left, found.unknown.first(), found.gains);
        found.decisions.iter().for_each(|line| eprintln!("{line}"));
    }
}
