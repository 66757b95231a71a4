//! Machine of a run: cores, instruction set, and the unit of compute times.

use std::thread;
use std::time::Instant;

use deploy::report::Machine;
use tch::{Device, Kind, Tensor};

/// Variables that limit the instructions of libtorch and its libraries, with the values that hold them to AVX2.
pub(crate) const AVX2: [(&str, &str); 3] = [
    ("ONEDNN_MAX_CPU_ISA", "AVX2"),
    ("ATEN_CPU_CAPABILITY", "avx2"),
    ("MKL_ENABLE_INSTRUCTIONS", "AVX2"),
];
/// Feature map and kernel of the unit: those of a detector's first block, 906 million operations.
const MAP: [i64; 4] = [1, 64, 96, 128];
const KERNEL: [i64; 4] = [64, 64, 3, 3];
/// Number of convolutions of which the shortest counts.
const REPETITIONS: usize = 10;

/// This machine.
pub(crate) fn this_machine() -> Machine {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let limits = AVX2
        .iter()
        .filter_map(|(name, _)| Some(format!("{name}={}", std::env::var(name).ok()?)));
    let limited = match &Vec::from_iter(limits)[..] {
        [] => String::new(),
        limits => format!(" (limited by {})", limits.join(" ")),
    };
    Machine {
        cores,
        instructions: instructions() + &limited,
    }
}

/// Vector instructions of the processor.
#[cfg(target_arch = "x86_64")]
fn instructions() -> String {
    let has_avx512 = is_x86_feature_detected!("avx512f");
    let has_avx2 = is_x86_feature_detected!("avx2");
    let has_vnni = is_x86_feature_detected!("avx512vnni") || is_x86_feature_detected!("avxvnni");
    let names = [
        (has_avx2 && !has_avx512).then_some("AVX2"),
        has_avx512.then_some("AVX-512"),
        has_vnni.then_some("VNNI"),
        has_amx().then_some("AMX"),
    ];
    match &Vec::from_iter(names.into_iter().flatten())[..] {
        [] => "no AVX2".into(),
        names => names.join(", "),
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

/// The unit of compute times: the shortest of some convolutions on one thread of this process, milliseconds.
pub fn unit_ms() -> f64 {
    // One thread, so that the unit does not depend on the number of cores.
    tch::set_num_threads(1);
    let options = (Kind::Float, Device::Cpu);
    let (map, kernel) = (Tensor::ones(MAP, options), Tensor::ones(KERNEL, options));
    let times = (0..=REPETITIONS).map(|_| {
        let began = Instant::now();
        drop(tch::no_grad(|| {
            map.conv2d(&kernel, None::<&Tensor>, 1, 1, 1, 1)
        }));
        began.elapsed().as_secs_f64() * 1e3
    });
    // The first one prepares the kernel, and is never the shortest.
    times.fold(f64::MAX, f64::min)
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
        let unit_ms = unit_ms();
        assert!(unit_ms > 0.1 && unit_ms < 1e4, "{unit_ms}");
    }
}
