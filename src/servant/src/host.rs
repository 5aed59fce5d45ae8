//! Resources of the host and their pressure: `/proc/meminfo` and pressure stall information (PSI).

use std::fs;
use std::path::Path;

use api::Pressure;

/// Returns the host's total memory in bytes; `None` if `/proc/meminfo` cannot be read.
pub fn total_memory() -> Option<u64> {
    parse_meminfo("MemTotal:", &fs::read_to_string("/proc/meminfo").ok()?)
}

/// Returns the percentage of the host's memory still available to programs (`MemAvailable`); `None` if `/proc/meminfo`
/// cannot be read.
pub fn available_memory_percent() -> Option<f64> {
    let meminfo = fs::read_to_string("/proc/meminfo").ok()?;
    let total = parse_meminfo("MemTotal:", &meminfo).filter(|total| *total > 0)?;
    Some(parse_meminfo("MemAvailable:", &meminfo)? as f64 / total as f64 * 100.0)
}

fn parse_meminfo(key: &str, meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix(key))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    Some(kib * 1024)
}

/// Returns the pressure of the whole host; `None` if the kernel does not report it.
pub fn pressure() -> Option<Pressure> {
    read_pressure(Path::new("/proc/pressure"), "")
}

/// Returns the percentage of the last ten seconds in which everything was stalled on memory (`full avg10`); `None` if
/// the kernel does not report it.
pub fn memory_stall_percent() -> Option<f64> {
    parse_avg10("full ", &fs::read_to_string("/proc/pressure/memory").ok()?)
}

/// Returns the bytes read back from swap since boot; `None` if the kernel does not report it.
pub fn swapped_in_bytes() -> Option<u64> {
    let pages = parse_swapped_in_pages(&fs::read_to_string("/proc/vmstat").ok()?)?;
    Some(pages.saturating_mul(page_size()))
}

fn parse_swapped_in_pages(vmstat: &str) -> Option<u64> {
    let pages = vmstat.lines().find_map(|line| line.strip_prefix("pswpin "))?;
    pages.trim().parse().ok()
}

fn page_size() -> u64 {
    let size = nix::unistd::sysconf(nix::unistd::SysconfVar::PAGE_SIZE);
    size.ok().flatten().and_then(|size| u64::try_from(size).ok()).unwrap_or(4096)
}

/// Reads the pressure of a directory in a v2 cgroup hierarchy, which needs no controller; `None` if the kernel was
/// built or booted without PSI.
pub(crate) fn cgroup_pressure(directory: &Path) -> Option<Pressure> {
    read_pressure(directory, ".pressure")
}

fn read_pressure(directory: &Path, suffix: &str) -> Option<Pressure> {
    let of = |name: &str| {
        let text = fs::read_to_string(directory.join(format!("{name}{suffix}"))).ok()?;
        parse_avg10("some ", &text)
    };
    Some(Pressure { cpu: of("cpu")?, memory: of("memory").unwrap_or(0.0), io: of("io").unwrap_or(0.0) })
}

/// Reads `avg10`, in percent, of the line of a pressure file that starts with `line`.
fn parse_avg10(line: &str, text: &str) -> Option<f64> {
    let found = text.lines().find_map(|one| one.strip_prefix(line))?;
    found.split(' ').find_map(|pair| pair.strip_prefix("avg10=")?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_texts_are_read() {
        let meminfo = "MemTotal:       16316412 kB\nMemFree:         1204 kB\n";
        assert_eq!(parse_meminfo("MemTotal:", meminfo), Some(16_316_412 * 1024));
        assert_eq!(parse_meminfo("MemTotal:", "MemFree: 1204 kB\n"), None);
        let pressure = "some avg10=1.53 avg60=0.87 avg300=0.20 total=1\nfull avg10=0.25 avg60=0.00 avg300=0.00 \
                        total=0\n";
        assert_eq!(parse_avg10("some ", pressure), Some(1.53));
        assert_eq!(parse_avg10("full ", pressure), Some(0.25));
        assert_eq!(parse_avg10("some ", ""), None);
        assert_eq!(parse_swapped_in_pages("pswpout 1\npswpin 42\n"), Some(42));
        assert_eq!(parse_swapped_in_pages("pswpout 1\n"), None);
    }
}
