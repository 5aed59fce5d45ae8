//! Bytes carried by the robot's cable, from the counters of its end.

use anyhow::{Context, Result};

/// Returns the bytes of packets sent and received so far on all devices of this network namespace except the loopback.
pub(super) fn read_counters() -> Result<Option<[u64; 2]>> {
    let path = "/proc/self/net/dev";
    let text = std::fs::read_to_string(path).context(path)?;
    Ok(sum_devices(&text))
}

/// Parses `/proc/net/dev` (proc_net(5)): received bytes are the first column, transmitted ones the ninth. Returns
/// `None` without such a device.
fn sum_devices(text: &str) -> Option<[u64; 2]> {
    let devices = text.lines().filter_map(|line| line.split_once(':'));
    let counted = devices.filter_map(|(name, columns)| {
        let columns: Vec<u64> = columns.split_whitespace().filter_map(|word| word.parse().ok()).collect();
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
            face |bytes    packets errs drop fifo frame compressed multicast|bytes    packets errs drop fifo colls \
            carrier compressed\n    \
            lo: 9999999 100 0 0 0 0 0 0 9999999 100 0 0 0 0 0 0\n  \
            cs1: 5 1 0 0 0 0 0 0 70 2 0 0 0 0 0 0\n";
        assert_eq!(sum_devices(text), Some([70, 5]));
        assert_eq!(sum_devices("lo: 1 1 0 0 0 0 0 0 1 1 0 0 0 0 0 0\n"), None);
    }
}
