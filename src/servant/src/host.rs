//! What the host has, and how much it waits: `/proc/meminfo` and pressure stall information (PSI).

use std::fs;
use std::path::Path;

use api::Pressure;

/// Bytes of memory that the host has; none where `/proc/meminfo` cannot be read.
pub fn memory() -> Option<u64> {
    bytes_of("MemTotal:", &fs::read_to_string("/proc/meminfo").ok()?)
}

/// Percent of the host's memory that programs could still be given (`MemAvailable`); none where `/proc/meminfo` cannot be
/// read.
pub fn memory_available() -> Option<f64> {
    let meminfo = fs::read_to_string("/proc/meminfo").ok()?;
    let total = bytes_of("MemTotal:", &meminfo).filter(|total| *total > 0)?;
    Some(bytes_of("MemAvailable:", &meminfo)? as f64 / total as f64 * 100.0)
}

fn bytes_of(key: &str, meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix(key))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    Some(kib * 1024)
}

/// How much the whole host waits; none where its kernel does not tell.
pub fn pressure() -> Option<Pressure> {
    pressure_in(Path::new("/proc/pressure"), "")
}

/// Percent of the last ten seconds in which nothing could run since all waited for memory (`full avg10`); none where the
/// kernel does not tell.
pub fn memory_stalled() -> Option<f64> {
    avg10("full ", &fs::read_to_string("/proc/pressure/memory").ok()?)
}

/// Bytes that were read back from swap since the host was started; none where its kernel does not tell.
pub fn swapped_in() -> Option<u64> {
    let pages = pages_in(&fs::read_to_string("/proc/vmstat").ok()?)?;
    Some(pages.saturating_mul(page_size()))
}

fn pages_in(vmstat: &str) -> Option<u64> {
    let pages = vmstat
        .lines()
        .find_map(|line| line.strip_prefix("pswpin "))?;
    pages.trim().parse().ok()
}

fn page_size() -> u64 {
    let size = nix::unistd::sysconf(nix::unistd::SysconfVar::PAGE_SIZE);
    size.ok()
        .flatten()
        .and_then(|size| u64::try_from(size).ok())
        .unwrap_or(4096)
}

/// Pressure in a directory of a v2 cgroup hierarchy, where it is there without any controller; none where the kernel was
/// built or booted without.
pub(crate) fn pressure_of_cgroup(directory: &Path) -> Option<Pressure> {
    pressure_in(directory, ".pressure")
}

fn pressure_in(directory: &Path, suffix: &str) -> Option<Pressure> {
    let of = |name: &str| {
        let text = fs::read_to_string(directory.join(format!("{name}{suffix}"))).ok()?;
        avg10("some ", &text)
    };
    Some(Pressure {
        cpu: of("cpu")?,
        memory: of("memory").unwrap_or(0.0),
        io: of("io").unwrap_or(0.0),
    })
}

/// `avg10` of the line of a pressure file that begins so, in percent.
fn avg10(line: &str, text: &str) -> Option<f64> {
    let found = text.lines().find_map(|one| one.strip_prefix(line))?;
    found
        .split(' ')
        .find_map(|pair| pair.strip_prefix("avg10=")?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_texts_are_read() {
        let meminfo = "MemTotal:       16316412 kB\nMemFree:         1204 kB\n";
        assert_eq!(bytes_of("MemTotal:", meminfo), Some(16_316_412 * 1024));
        assert_eq!(bytes_of("MemTotal:", "MemFree: 1204 kB\n"), None);
        let pressure = "some avg10=1.53 avg60=0.87 avg300=0.20 total=1\nfull avg10=0.25 avg60=0.00 avg300=0.00 total=0\n";
        assert_eq!(avg10("some ", pressure), Some(1.53));
        assert_eq!(avg10("full ", pressure), Some(0.25));
        assert_eq!(avg10("some ", ""), None);
        assert_eq!(pages_in("pswpout 1\npswpin 42\n"), Some(42));
        assert_eq!(pages_in("pswpout 1\n"), None);
    }
}
