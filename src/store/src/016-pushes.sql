-- Pushes of late, and what they printed.
CREATE TABLE pushes (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    -- Absent while it is not known.
    service TEXT,
    source  TEXT NOT NULL,
    who     TEXT NOT NULL,
    began   INTEGER NOT NULL,
    -- Absent while the push runs, and if the daemon ended before it did.
    ended   INTEGER,
    state   TEXT NOT NULL,
    step    TEXT NOT NULL DEFAULT '',
    message TEXT,
    -- Events as JSON lines.
    output  TEXT NOT NULL DEFAULT ''
) STRICT;

-- How long a step took when it was completed last, in milliseconds.
CREATE TABLE push_steps (
    subject TEXT NOT NULL,
    title   TEXT NOT NULL,
    took    INTEGER NOT NULL,
    at      INTEGER NOT NULL,
    PRIMARY KEY (subject, title)
) STRICT;
CREATE INDEX push_steps_title ON push_steps (title, at);
CREATE INDEX push_steps_at ON push_steps (at);
