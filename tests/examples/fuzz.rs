//! `cargo run --release -p mazeway-tests --example fuzz -- EXECUTIONS SEED [TARGET]...`: fuzzes the readers of bytes from
//! outside and prints a line a target. With `KEEP=DIR` inputs that led to new answers are written there.

use mazeway_tests::fuzz::{
    run,
    targets::{TARGETS, find},
};
use std::{env, fs, path::PathBuf, time::Instant};

fn main() {
    let arguments = env::args().skip(1).collect::<Vec<_>>();
    let number = |i: usize, otherwise: u64| arguments.get(i).map_or(otherwise, |text| text.parse().expect("a number"));
    let (executions, seed) = (number(0, 100_000), number(1, 1));
    let targets = match arguments.get(2..) {
        Some(names @ [_, ..]) => names.iter().map(|name| *find(name).expect("the name of a target")).collect(),
        _ => TARGETS.to_vec(),
    };
    let keep = env::var_os("KEEP").map(PathBuf::from);
    // A panic is told with its input.
    std::panic::set_hook(Box::new(|panic| eprintln!("{panic}")));
    println!(
        "{:<26} {:>12} {:>10} {:>8} {:>12} {:>9} {:>9}",
        "target", "executions", "accepted", "answers", "peak, bytes", "longest", "took"
    );
    for target in targets {
        let begun = Instant::now();
        let meter = |work: &mut dyn FnMut()| allocation_counter::measure(work).bytes_max;
        let mut kept = 0;
        let tally = run(&target, executions, seed, meter, |input, _| {
            if let Some(directory) = &keep {
                let directory = directory.join(target.name);
                fs::create_dir_all(&directory).expect("a directory");
                fs::write(directory.join(format!("{seed}-{kept:04}")), input).expect("a file");
                kept += 1;
            }
        });
        println!(
            "{:<26} {:>12} {:>10} {:>8} {:>12} {:>7.3} s {:>7.0} s",
            target.name,
            tally.executions,
            tally.accepted,
            tally.answers,
            tally.peak_bytes,
            tally.longest_secs,
            begun.elapsed().as_secs_f64()
        );
    }
    // What SQLite's own memory and the corpus come to is in the process's peak.
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(peak) = status.lines().find(|line| line.starts_with("VmHWM")) {
        println!("resident memory of the process at its peak: {}", peak.trim_start_matches("VmHWM:").trim());
    }
}
