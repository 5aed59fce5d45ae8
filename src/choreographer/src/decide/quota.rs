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
pub fn find_files_to_evict(files: &[QuotaFile<'_>], new: QuotaFile<'_>, quota: Quota) -> Vec<usize> {
    let mut left: Vec<usize> = (0..files.len()).collect();
    let mut gone = Vec::new();
    loop {
        let sum: u64 = left.iter().map(|place| files[*place].bytes).sum();
        let has_too_many = left.len() >= quota.files;
        if !has_too_many && sum.saturating_add(new.bytes) <= quota.bytes {
            return gone;
        }
        let (mut owners, mut services) = (BTreeMap::new(), BTreeMap::new());
        for file in left.iter().map(|place| files[*place]).chain([new]) {
            let used = if has_too_many { 1 } else { file.bytes };
            *owners.entry(file.owner).or_insert(0) += used;
            *services.entry(file.service).or_insert(0) += used;
        }
        // Of equals, the new file's own service.
        let rank = |file: &QuotaFile<'_>| (owners[file.owner], services[file.service], file.service == new.service);
        let most = left.iter().map(|place| files[*place]).max_by_key(rank);
        let oldest = left.iter().rposition(|place| most.is_some_and(|most| most.service == files[*place].service));
        let Some(oldest) = oldest else {
            return gone;
        };
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
        let gone = |all: &[(&str, u64)], new: (&str, u64), (count, bytes)| {
            let all: Vec<_> = all.iter().map(|(service, bytes)| file(("", *service, *bytes))).collect();
            find_files_to_evict(&all, file(("", new.0, new.1)), Quota { files: count, bytes })
        };
        let all = [("busy", 10), ("busy", 10), ("busy", 10), ("quiet", 25), ("quiet", 1)];
        // There is room.
        assert_eq!(gone(&all, ("busy", 4), (6, 60)), [] as [usize; 0]);
        // By number: the busy service has most, whichever is new.
        assert_eq!(gone(&all, ("busy", 1), (5, 60)), [2]);
        assert_eq!(gone(&all, ("new", 1), (5, 60)), [2]);
        assert_eq!(gone(&all, ("quiet", 1), (5, 60)), [4]);
        // By bytes.
        assert_eq!(gone(&all, ("busy", 10), (9, 60)), [2]);
        assert_eq!(gone(&all, ("new", 15), (9, 60)), [2, 4]);
        // One that needs everything.
        assert_eq!(gone(&all, ("busy", 40), (9, 60)), [2, 1, 0, 4, 3]);
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
            let mut gone = find_files_to_evict(&known, new, quota);
            gone.sort_unstable();
            for place in gone.into_iter().rev() {
                known.remove(place);
            }
            known.insert(0, new);
        }
        assert_eq!(known, [file(("bob", "busy49", 10)), file(("bob", "busy48", 10)), quiet]);
    }
}
