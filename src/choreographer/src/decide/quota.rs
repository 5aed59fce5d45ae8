//! Decides which files are removed for a new one, where services share a quota.

use std::collections::BTreeMap;

/// A file of a service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QuotaFile<'a> {
    /// Owner of the service; empty if it has none.
    pub owner: &'a str,
    /// Name of the service.
    pub service: &'a str,
    /// Size in bytes.
    pub bytes: u64,
}

/// Largest number and size of all files together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quota {
    /// Number of files.
    pub files: usize,
    /// Size in bytes.
    pub bytes: u64,
}

/// Returns the places in `files`, which has the newest first, of the files to remove for a new one. Of the owner that
/// uses most, including the new file, the service that uses most loses its oldest; so nobody can drive out the files of
/// those that use less, by however many files or services.
///
/// Returns `None` if the new file would be the one to go, because those that are left use less: it is not to be kept,
/// and nothing is to be removed for it.
pub fn find_files_to_evict(files: &[QuotaFile<'_>], new: QuotaFile<'_>, quota: Quota) -> Option<Vec<usize>> {
    let mut left: Vec<usize> = (0..files.len()).collect();
    let mut gone = Vec::new();
    loop {
        let sum = left.iter().fold(new.bytes, |sum, place| sum.saturating_add(files[*place].bytes));
        let has_too_many = left.len() >= quota.files;
        if !has_too_many && sum <= quota.bytes {
            return Some(gone);
        }
        let (mut owners, mut services) = (BTreeMap::new(), BTreeMap::new());
        for file in left.iter().map(|place| files[*place]).chain([new]) {
            let used = if has_too_many { 1 } else { file.bytes };
            *owners.entry(file.owner).or_insert(0) += used;
            *services.entry(file.service).or_insert(0) += used;
        }
        let used = |file: &QuotaFile<'_>| (owners[file.owner], services[file.service]);
        // Of equals, the new file's own service.
        let most =
            left.iter().map(|place| files[*place]).max_by_key(|file| (used(file), file.service == new.service))?;
        if used(&new) > used(&most) {
            return None;
        }
        let oldest = left.iter().rposition(|place| most.service == files[*place].service)?;
        gone.push(left.remove(oldest));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file<'a>((owner, service, bytes): (&'a str, &'a str, u64)) -> QuotaFile<'a> {
        QuotaFile { owner, service, bytes }
    }

    #[test]
    fn the_service_that_takes_most_loses_its_oldest() {
        let gone = |all: &[(&str, u64)], new: (&str, u64), (count, bytes)| -> Option<Vec<usize>> {
            let all: Vec<_> = all.iter().map(|(service, bytes)| file(("", *service, *bytes))).collect();
            find_files_to_evict(&all, file(("", new.0, new.1)), Quota { files: count, bytes })
        };
        let all = [("busy", 10), ("busy", 10), ("busy", 10), ("quiet", 25), ("quiet", 1)];
        // There is room.
        assert_eq!(gone(&all, ("busy", 4), (6, 60)), Some(vec![]));
        // By number: the busy service has most, whichever is new.
        assert_eq!(gone(&all, ("busy", 1), (5, 60)), Some(vec![2]));
        assert_eq!(gone(&all, ("new", 1), (5, 60)), Some(vec![2]));
        assert_eq!(gone(&all, ("quiet", 1), (5, 60)), Some(vec![4]));
        // By bytes.
        assert_eq!(gone(&all, ("busy", 10), (9, 60)), Some(vec![2]));
        assert_eq!(gone(&all, ("new", 15), (9, 60)), Some(vec![2, 4]));
        // One that would leave the quiet service nothing, although that uses less, and one that never fits.
        assert_eq!(gone(&all, ("busy", 34), (9, 60)), Some(vec![2, 1, 0]));
        assert_eq!(gone(&all, ("busy", 35), (9, 60)), None);
        assert_eq!(gone(&[], ("busy", 61), (9, 60)), None);
        // Of those that use as much, the new file stays.
        assert_eq!(gone(&[("old", 60)], ("new", 60), (9, 60)), Some(vec![0]));
        assert_eq!(gone(&[("old", 1)], ("new", 1), (1, 60)), Some(vec![0]));
    }

    #[test]
    fn the_quiet_ones_keep_their_files_however_many_the_others_make() {
        let quota = Quota { files: 3, bytes: 1000 };
        let quiet = file(("ann", "quiet", 10));
        let mut known = vec![quiet];
        // An owner cannot take more by more services either.
        let services: Vec<String> = (0..50).map(|number| format!("busy{number}")).collect();
        for service in &services {
            let new = file(("bob", service, 10));
            let mut gone = find_files_to_evict(&known, new, quota).expect("it may be kept");
            gone.sort_unstable();
            for place in gone.into_iter().rev() {
                known.remove(place);
            }
            known.insert(0, new);
        }
        assert_eq!(known, [file(("bob", "busy49", 10)), file(("bob", "busy48", 10)), quiet]);
    }

    #[test]
    fn a_file_that_fills_a_small_quota_does_not_drive_out_those_of_others() {
        let quota = Quota { files: 1000, bytes: 32 << 20 };
        let quiet = [file(("ann", "quiet", 1 << 10)), file(("cid", "calm", 1 << 10))];
        assert_eq!(find_files_to_evict(&quiet, file(("bob", "busy", 32 << 20)), quota), None);
        // Those of one's own services that use more go first.
        let known = [quiet[0], quiet[1], file(("bob", "busy", 20 << 20))];
        assert_eq!(find_files_to_evict(&known, file(("bob", "other", 12 << 20)), quota), Some(vec![2]));
        assert_eq!(find_files_to_evict(&known, file(("bob", "other", 21 << 20)), quota), None);
    }
}
