//! Machine of a run: cores, instruction set, and what its cores do together.

use std::sync::Barrier;
use std::thread;
use std::time::{Duration, Instant};

use deploy::report::Machine;
use tch::{Device, Kind, Tensor};

/// Variables that limit the instructions of libtorch and its libraries.
const LIMITS: [&str; 3] = [
    "ONEDNN_MAX_CPU_ISA",
    "ATEN_CPU_CAPABILITY",
    "MKL_ENABLE_INSTRUCTIONS",
];
/// Feature map and kernel of the convolution that the cores are compared with: those of a detector's first block.
const MAP: [i64; 4] = [1, 64, 96, 128];
const KERNEL: [i64; 4] = [64, 64, 3, 3];
/// Number of these convolutions.
const REPETITIONS: usize = 6;
/// Passes over the map behind each: networks and messages move as much memory as this beside their arithmetic.
const PASSES: usize = 4;

/// This machine.
pub(crate) fn this_machine() -> Machine {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let limits = LIMITS
        .iter()
        .filter_map(|name| Some(format!("{name}={}", std::env::var(name).ok()?)));
    let limits: Vec<String> = limits.collect();
    let limited = if limits.is_empty() {
        String::new()
    } else {
        format!(" (limited by {})", limits.join(" "))
    };
    Machine {
        cores,
        instructions: instructions() + &limited,
    }
}

/// Vector instructions of the processor.
#[cfg(target_arch = "x86_64")]
fn instructions() -> String {
    let has = [
        (
            "AVX2",
            is_x86_feature_detected!("avx2") && !is_x86_feature_detected!("avx512f"),
        ),
        ("AVX-512", is_x86_feature_detected!("avx512f")),
        (
            "VNNI",
            is_x86_feature_detected!("avx512vnni") || is_x86_feature_detected!("avxvnni"),
        ),
        ("AMX", has_amx()),
    ];
    let names: Vec<&str> = has
        .iter()
        .filter(|(_, is_there)| *is_there)
        .map(|(name, _)| *name)
        .collect();
    if names.is_empty() {
        "no AVX2".into()
    } else {
        names.join(", ")
    }
}

/// Vector instructions of the processor.
#[cfg(not(target_arch = "x86_64"))]
fn instructions() -> String {
    std::env::consts::ARCH.into()
}

/// True if the system offers matrix tiles; the standard library does not yet detect them.
#[cfg(target_arch = "x86_64")]
fn has_amx() -> bool {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    info.lines()
        .find(|line| line.starts_with("flags"))
        .is_some_and(|line| line.contains(" amx_int8"))
}

/// Speed of the cores.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CoreSpeed {
    /// Shortest time of one convolution of [`MAP`] with [`KERNEL`], milliseconds.
    pub(crate) unit_ms: f64,
    /// Speed of a core while others compute, relative to one that computes alone, at most 1. Two hyperthreads of one
    /// core, as many virtual machines have them, reach little more than 0.5; other programs lower it too.
    pub(crate) shared: f64,
}

impl CoreSpeed {
    /// Measures this machine with `threads` cores that compute together.
    #[must_use]
    pub(crate) fn measure(threads: usize) -> Self {
        let (unit, alone) = convolve_together(1);
        let (_, together) = convolve_together(threads);
        Self {
            unit_ms: unit.as_secs_f64() * 1e3,
            shared: (alone.as_secs_f64() / together.as_secs_f64().max(1e-9)).min(1.0),
        }
    }
}

/// Shortest convolution, and mean time of all, on each of `threads` threads that begin together.
fn convolve_together(threads: usize) -> (Duration, Duration) {
    let (begin, count) = (
        Barrier::new(threads),
        u32::try_from(threads).unwrap_or(u32::MAX),
    );
    let (shortest, total) = thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|_| scope.spawn(|| convolve(&begin)))
            .collect();
        workers
            .into_iter()
            .map(|worker| worker.join().unwrap_or_default())
            .fold((Duration::MAX, Duration::ZERO), |all, (unit, time)| {
                (all.0.min(unit), all.1 + time)
            })
    });
    (shortest, total / count.max(1))
}

/// Shortest convolution, and time of all with the passes behind them.
fn convolve(begin: &Barrier) -> (Duration, Duration) {
    // The number of threads is a property of the calling thread.
    tch::set_num_threads(1);
    let (map, kernel) = (
        Tensor::ones(MAP, (Kind::Float, Device::Cpu)),
        Tensor::ones(KERNEL, (Kind::Float, Device::Cpu)),
    );
    let step = || tch::no_grad(|| map.conv2d(&kernel, None::<&Tensor>, 1, 1, 1, 1));
    // The first one prepares the kernel.
    drop(step());
    begin.wait();
    let (began, mut shortest) = (Instant::now(), Duration::MAX);
    for _ in 0..REPETITIONS {
        let unit_began = Instant::now();
        let convolved = step();
        shortest = shortest.min(unit_began.elapsed());
        (0..PASSES).for_each(|_| drop(&convolved + &map));
    }
    (shortest, began.elapsed())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_cores_and_instructions() {
        let machine = this_machine();
        assert!(
            machine.cores > 0 && !machine.instructions.is_empty(),
            "{machine:?}"
        );
        let speed = CoreSpeed::measure(2);
        assert!(
            speed.unit_ms > 0.0 && speed.shared > 0.0 && speed.shared <= 1.0,
            "{speed:?}"
        );
    }
}
