//! A shim idles for most of its life; what it needed to get there it gives back.

use std::fs;
use std::time::Duration;

use crate::sys;

/// After its nodes were started, when they have registered.
const AT_REST: Duration = Duration::from_secs(2);

/// Now what was allocated, and once the servant is at rest the pages of programs and libraries: most of them are
/// libcontainer's, which is not needed again.
pub(super) fn give_back() {
    sys::give_back_memory();
    tokio::task::spawn_local(async {
        tokio::time::sleep(AT_REST).await;
        forget_files();
    });
}

fn forget_files() {
    let maps = fs::read_to_string("/proc/self/maps").unwrap_or_default();
    for (start, end) in maps.lines().filter_map(unchanged_file) {
        // SAFETY: code and constants, which are mapped without the right to write and never were otherwise.
        unsafe { sys::forget_pages(start, end) };
    }
}

/// Where a line of `/proc/PID/maps` is about pages that nobody can have changed, so that they can be read again: code, and
/// constants. Those at the beginning of a file only: others may be tables that the dynamic linker wrote.
fn unchanged_file(line: &str) -> Option<(usize, usize)> {
    let mut fields = line.split_whitespace();
    let (range, access, offset) = (fields.next()?, fields.next()?, fields.next()?);
    let file = fields.nth(2).is_some_and(|path| path.starts_with('/'));
    let code = access == "r-xp";
    let constants = access == "r--p" && usize::from_str_radix(offset, 16) == Ok(0);
    if !file || !(code || constants) {
        return None;
    }
    let (start, end) = range.split_once('-')?;
    let number = |text| usize::from_str_radix(text, 16).ok();
    Some((number(start)?, number(end)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_cannot_have_changed_is_forgotten() {
        let at = |rest: &str| unchanged_file(&format!("1000-3000 {rest}")).is_some();
        assert!(at("r-xp 00417000 fe:00 42   /usr/bin/cloudroidd"), "code");
        assert!(
            at("r--p 00000000 fe:00 42   /usr/bin/cloudroidd"),
            "constants"
        );
        assert!(
            !at("r--p 01240000 fe:00 42   /usr/bin/cloudroidd"),
            "relocated"
        );
        assert!(!at("rw-p 00000000 fe:00 42   /usr/bin/cloudroidd"), "data");
        assert!(!at("r-xp 00000000 00:00 0   [vdso]"), "no file");
        assert!(!at("rw-p 00000000 00:00 0"), "no name");
        assert_eq!(
            unchanged_file("1000-3000 r-xp 0 fe:00 42 /a"),
            Some((0x1000, 0x3000))
        );
    }

    #[test]
    fn code_that_was_forgotten_still_runs() {
        let maps = fs::read_to_string("/proc/self/maps").expect("maps");
        assert!(maps.lines().any(|line| unchanged_file(line).is_some()));
        forget_files();
        assert_eq!(format!("{:?}", AT_REST), "2s");
    }
}
