//! Evidence kept of a failed story: logs of its daemons and servants, events, processes of the machine, and the files
//! that it created. Long logs are cut in the middle, and beyond a size in all the oldest evidence goes.

use std::cmp::Reverse;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use crate::binaries;
use crate::daemon::Daemon;
use crate::story::{self, StoryRun};

/// Parts of a home that are omitted: images and unpacked layers, which are the same for all, and recordings.
const HEAVY: [&str; 4] = ["images", "layers", "build", "recordings"];
/// Larger texts are cut in the middle, and other files are omitted.
const LARGEST_FILE: u64 = 4 << 20;
/// Maximum size of the evidence of one run of a story.
const LARGEST: u64 = 64 << 20;
/// Maximum size of the evidence of all stories.
const LARGEST_OF_ALL: u64 = 512 << 20;
/// File that every evidence has.
const REASON: &str = "reason";

/// Held while evidence is kept: what one story has just kept is not removed for that of another.
static KEEPING: Mutex<()> = Mutex::new(());

/// Records the processes and the load of the machine for the story of this thread; called when the story stops waiting,
/// before it stops its daemons.
pub fn note_machine() {
    if let Some(telling) = story::current() {
        note_machine_in(&telling.evidence);
    }
}

fn note_machine_in(directory: &Path) {
    if directory.join("ps").exists() || fs::create_dir_all(directory).is_err() {
        return;
    }
    let columns = "pid,ppid,stat,etimes,time,pcpu,rss,wchan:20,args";
    if let Ok(output) = Command::new("ps").args(["-e", "-o", columns]).output() {
        let _ = fs::write(directory.join("ps"), output.stdout);
    }
    let mut text = String::new();
    for name in ["loadavg", "pressure/cpu", "pressure/io", "pressure/memory", "meminfo"] {
        let said = fs::read_to_string(Path::new("/proc").join(name));
        let said = said.unwrap_or_else(|error| format!("{error}\n"));
        text.push_str(&format!("== /proc/{name}\n{said}"));
    }
    let _ = fs::write(directory.join("machine"), text);
}

/// Keeps everything that a failed story has created, with the error. `shared` is the shared daemon, which it may have
/// used.
///
/// # Errors
/// If nothing can be written.
pub fn keep(telling: &StoryRun, reason: &str, seed: &str, shared: Option<&Daemon>) -> std::io::Result<()> {
    let _turn = KEEPING.lock().unwrap_or_else(PoisonError::into_inner);
    let place = &telling.evidence;
    fs::create_dir_all(place)?;
    fs::write(place.join(REASON), format!("{}\n{reason}\nseed: {seed}\n", telling.name))?;
    note_machine_in(place);
    let mut room = LARGEST;
    for home in telling.homes() {
        let to = place.join("homes").join(home.file_name().unwrap_or_default());
        copy(&home, &to, &mut room);
        write_events(&home, &to.join("events.jsonl"));
    }
    for directory in telling.directories() {
        copy(&directory, &place.join("directories").join(directory.file_name().unwrap_or_default()), &mut room);
    }
    if let Some(daemon) = shared {
        let to = place.join("shared");
        fs::create_dir_all(&to)?;
        copy(&daemon.home.join("daemon.log"), &to.join("daemon.log"), &mut room);
        copy(&daemon.home.join("servants"), &to.join("servants"), &mut room);
        if let Ok(events) = daemon.api("/api/v1/events?limit=10000") {
            let _ = fs::write(to.join("events.json"), format!("{events:#}"));
        }
    }
    bound(&binaries::target().join("stories"), place, LARGEST_OF_ALL);
    Ok(())
}

/// Writes the events of a home's database, one per line; a stopped daemon could not be asked for them.
fn write_events(home: &Path, to: &Path) {
    const READ: &str = "import json, sqlite3, sys
rows = sqlite3.connect(f'file:{sys.argv[1]}?mode=ro', uri=True)
rows.row_factory = sqlite3.Row
for row in rows.execute('SELECT * FROM events ORDER BY id'):
    print(json.dumps({key: row[key] for key in row.keys() if not isinstance(row[key], bytes)}))
";
    let database = home.join("cloudroid.db");
    if database.exists()
        && let Ok(output) = Command::new("python3").args(["-c", READ]).arg(database).output()
        && let Ok(mut file) = fs::File::create(to)
    {
        let _ = file.write_all(&output.stdout).and_then(|()| file.write_all(&output.stderr));
    }
}

/// Copies directories and files up to a maximum size; unreadable ones are omitted.
fn copy(from: &Path, to: &Path, room: &mut u64) {
    let Ok(about) = from.symlink_metadata() else {
        return;
    };
    if about.is_dir() && fs::create_dir_all(to).is_ok() {
        for entry in fs::read_dir(from).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if !HEAVY.iter().any(|heavy| name == *heavy) {
                copy(&entry.path(), &to.join(&name), room);
            }
        }
    }
    if about.is_file() {
        let copied = copy_cut(from, to, LARGEST_FILE.min(*room));
        *room = room.saturating_sub(copied.unwrap_or(0));
    }
}

/// Copies a file, or the first and the last part of a text of more than `most` bytes; another file of that size is
/// omitted. Returns the bytes copied.
///
/// # Errors
/// If the file cannot be read, or the copy not be written.
pub fn copy_cut(from: &Path, to: &Path, most: u64) -> std::io::Result<u64> {
    let mut file = File::open(from)?;
    let length = file.metadata()?.len();
    if length <= most {
        return fs::copy(from, to);
    }
    let half = most / 2;
    let (mut first, mut last) = (Vec::new(), Vec::new());
    Read::by_ref(&mut file).take(half).read_to_end(&mut first)?;
    if first.is_empty() || first.contains(&0) {
        return Ok(0);
    }
    file.seek(SeekFrom::Start(length - half))?;
    file.take(half).read_to_end(&mut last)?;
    let mut copy = File::create(to)?;
    copy.write_all(&first)?;
    write!(copy, "\n[{} bytes are left out here]\n", length - 2 * half)?;
    copy.write_all(&last)?;
    Ok(2 * half)
}

/// Evidence of one story.
struct KeptEvidence {
    place: PathBuf,
    written: SystemTime,
    bytes: u64,
}

/// Removes the oldest evidence below `root` until all has at most `most` bytes; what belongs to `newest` stays.
pub fn bound(root: &Path, newest: &Path, most: u64) {
    let mut all = Vec::new();
    find_evidence(root, &mut all);
    all.sort_by_key(|kept| Reverse(kept.written));
    let mut sum = 0;
    for kept in all {
        sum += kept.bytes;
        if sum > most && !newest.starts_with(&kept.place) {
            let _ = fs::remove_dir_all(&kept.place);
        }
    }
}

/// Finds the directories of stories, which have a reason of failure.
fn find_evidence(directory: &Path, found: &mut Vec<KeptEvidence>) {
    let written = directory.join(REASON).metadata().and_then(|about| about.modified());
    if let Ok(written) = written {
        found.push(KeptEvidence { place: directory.to_owned(), written, bytes: measure(directory) });
        return;
    }
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            find_evidence(&entry.path(), found);
        }
    }
}

/// Returns the size of all files below a directory.
fn measure(directory: &Path) -> u64 {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let sizes = entries.filter_map(|entry| {
        let about = entry.metadata().ok()?;
        Some(if about.is_dir() { measure(&entry.path()) } else { about.len() })
    });
    sizes.sum()
}
