use tokio::sync::oneshot;

use super::*;
use crate::logs::LogWriter;

async fn collect_all(mut lines: mpsc::Receiver<LogLine>) -> Vec<String> {
    let mut seen = Vec::new();
    while let Some(line) = lines.recv().await {
        seen.push(line.line);
    }
    seen
}

#[tokio::test]
async fn every_line_arrives_in_order_across_rotations() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 4000, u64::MAX).unwrap();
    writer.append("/a", "stdout", "0");
    let (end, ended) = oneshot::channel::<()>();
    let mut lines = follow(&Arc::default(), path.clone(), LogStart::First, async { drop(ended.await) }, ());
    for number in 1..500 {
        assert_eq!(lines.recv().await.unwrap().line, (number - 1).to_string());
        writer.append("/a", "stdout", &number.to_string());
    }
    end.send(()).unwrap();
    assert_eq!(collect_all(lines).await, ["499"]);
    assert!(rotated_path(&path).exists(), "it was rotated");
}

/// Returns the number of files below a directory that this process has open, and how many of them are deleted.
fn open_below(directory: &Path) -> (usize, usize) {
    let open = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    let targets = open.filter_map(|entry| std::fs::read_link(entry.path()).ok());
    let below: Vec<PathBuf> = targets.filter(|target| target.starts_with(directory)).collect();
    let removed = below.iter().filter(|path| path.to_string_lossy().ends_with(" (deleted)"));
    (below.len(), removed.count())
}

#[tokio::test]
async fn who_does_not_read_keeps_no_file_that_was_rotated_away() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 4000, u64::MAX).unwrap();
    writer.append("/a", "stdout", "0");
    let (end, ended) = oneshot::channel::<()>();
    let watches = Arc::new(DirectoryWatches::default());
    let mut lines = follow(&watches, path.clone(), LogStart::First, async { drop(ended.await) }, ());
    let mut told = watches.watch(home.path()).unwrap();
    let mut number = 0;
    for _rotation in 0..50 {
        let before = std::fs::metadata(rotated_path(&path)).map(|file| file.ino()).ok();
        while std::fs::metadata(rotated_path(&path)).map(|file| file.ino()).ok() == before {
            number += 1;
            writer.append("/a", "stdout", &number.to_string());
        }
        // The followers have noticed it when this watch, which was registered later, has.
        told.next_change().await;
        for _ in 0..10 {
            tokio::task::yield_now().await;
        }
    }
    let (open, removed) = open_below(home.path());
    assert!(open <= 6 && removed <= 1, "{open} open, {removed} of them removed");
    end.send(()).unwrap();
    assert_eq!(lines.recv().await.unwrap().line, "0");
    let seen = collect_all(lines).await;
    assert!(seen.iter().any(|line| line.contains("lines were lost here")), "{seen:?}");
    assert_eq!(seen.last().unwrap(), &number.to_string());
}

#[tokio::test]
async fn from_now_on_means_from_now_on_and_removal_loses_nothing() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 1 << 20, u64::MAX).unwrap();
    writer.append("/a", "stdout", "before");
    let (end, ended) = oneshot::channel::<()>();
    let lines = follow(&Arc::default(), path.clone(), LogStart::Now, async { drop(ended.await) }, ());
    writer.append("/a", "stderr", "after");
    drop(home);
    end.send(()).unwrap();
    assert_eq!(collect_all(lines).await, ["after"]);
}

#[tokio::test]
async fn the_last_lines_come_across_the_rotation_and_then_what_follows() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 1000, u64::MAX).unwrap();
    let mut written = 0;
    while written < 3 || !rotated_path(&path).exists() {
        writer.append("/a", "stdout", &written.to_string());
        written += 1;
    }
    let all_lines: Vec<String> = (0..written).map(|number| number.to_string()).collect();
    for count in [0, 1, 2, written - 1, written, written + 9] {
        let (end, ended) = oneshot::channel::<()>();
        let start = LogStart::Last(count);
        let lines = follow(&Arc::default(), path.clone(), start, async { drop(ended.await) }, ());
        end.send(()).unwrap();
        let expected = &all_lines[written - count.min(written)..];
        assert_eq!(collect_all(lines).await, expected, "the last {count}");
    }
    let (end, ended) = oneshot::channel::<()>();
    let start = LogStart::Last(1);
    let mut lines = follow(&Arc::default(), path.clone(), start, async { drop(ended.await) }, ());
    assert_eq!(lines.recv().await.unwrap().line, all_lines[written - 1]);
    writer.append("/a", "stdout", "after");
    end.send(()).unwrap();
    assert_eq!(collect_all(lines).await, ["after"]);
}

#[tokio::test]
async fn once_the_guard_is_dropped_the_log_may_go() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 200, u64::MAX).unwrap();
    writer.append("/a", "stdout", "first");
    let guards = watch::Sender::new(());
    let (end, ended) = oneshot::channel::<()>();
    let lines = follow(&Arc::default(), path.clone(), LogStart::First, async { drop(ended.await) }, guards.subscribe());
    writer.append("/a", "stdout", "second, rotated");
    end.send(()).unwrap();
    guards.closed().await;
    drop(home);
    assert_eq!(collect_all(lines).await, ["first", "second, rotated"]);
}

#[tokio::test]
async fn a_reader_too_slow_is_told_what_it_missed() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("log.jsonl");
    let mut writer = LogWriter::create(&path, 400, u64::MAX).unwrap();
    writer.append("/a", "stdout", "0");
    let lines = follow(&Arc::default(), path.clone(), LogStart::First, std::future::ready(()), ());
    for number in 1..100 {
        writer.append("/a", "stdout", &number.to_string());
    }
    let seen = collect_all(lines).await;
    assert_eq!(seen[0], "0");
    assert!(seen.iter().any(|line| line.contains("lines were lost here")), "{seen:?}");
    assert_eq!(seen.last().unwrap(), "99");
}
