//! What the robot's cable has carried, by the counters of its own end.

use anyhow::{Context, Result};

/// Bytes of packets that have left, and that have come, on all devices of this network namespace but the loopback.
pub(super) fn so_far() -> Result<Option<[u64; 2]>> {
    let path = "/proc/self/net/dev";
    let text = std::fs::read_to_string(path).context(path)?;
    Ok(sum(&text))
}

/// Of a `/proc/net/dev` (proc_net(5)): received bytes are the first column, transmitted ones the ninth. None without such a device.
fn sum(text: &str) -> Option<[u64; 2]> {
    let devices = text.lines().filter_map(|line| line.split_once(':'));
    let counted = devices.filter_map(|(name, columns)| {
        let columns: Vec<u64> = columns
            .split_whitespace()
            .filter_map(|word| word.parse().ok())
            .collect();
        let counts = [*columns.get(8)?, *columns.first()?];
        (name.trim() != "lo").then_some(counts)
    });
    counted.reduce(|sum, one| [sum[0] + one[0], sum[1] + one[1]])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_is_not_counted() {
        let text = "Inter-|   Receive                                                |  Transmit\n \
            face |bytes    packets errs drop fifo frame compressed multicast|bytes    packets errs drop fifo colls carrier compressed\n    \
            lo: 9999999 100 0 0 0 0 0 0 9999999 100 0 0 0 0 0 0\n  \
            cs1: 5 1 0 0 0 0 0 0 70 2 0 0 0 0 0 0\n";
        assert_eq!(sum(text), Some([70, 5]));
        assert_eq!(sum("lo: 1 1 0 0 0 0 0 0 1 1 0 0 0 0 0 0\n"), None);
    }
}
