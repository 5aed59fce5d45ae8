//! Evidence kept of a failed story: logs of its daemons and servants, events, processes of the machine, and the files
//! that it created.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::Command;

use crate::daemon::Daemon;
use crate::story::{self, StoryRun};

/// Parts of a home that are omitted: images and unpacked layers, which are the same for all.
const HEAVY: [&str; 3] = ["images", "layers", "build"];
/// Larger files are omitted.
const LARGEST_FILE: u64 = 16 << 20;
/// Maximum size of the evidence of one story.
const LARGEST: u64 = 256 << 20;

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
    let place = &telling.evidence;
    fs::create_dir_all(place)?;
    fs::write(place.join("reason"), format!("{}\n{reason}\nseed: {seed}\n", telling.name))?;
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
        let _ = fs::copy(daemon.home.join("daemon.log"), to.join("daemon.log"));
        copy(&daemon.home.join("servants"), &to.join("servants"), &mut room);
        if let Ok(events) = daemon.api("/api/v1/events?limit=10000") {
            let _ = fs::write(to.join("events.json"), format!("{events:#}"));
        }
    }
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
    if about.is_file() && about.len() <= LARGEST_FILE.min(*room) && fs::copy(from, to).is_ok() {
        *room -= about.len();
    }
}
