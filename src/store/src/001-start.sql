CREATE TABLE services (
    name    TEXT PRIMARY KEY,
    package TEXT NOT NULL,
    current INTEGER NOT NULL
) STRICT;

CREATE TABLE numbers (
    service TEXT PRIMARY KEY,
    last    INTEGER NOT NULL
) STRICT;

CREATE TABLE revisions (
    service   TEXT NOT NULL REFERENCES services (name) ON DELETE CASCADE,
    number    INTEGER NOT NULL,
    image     TEXT NOT NULL,
    published INTEGER NOT NULL,
    source    TEXT NOT NULL,
    plan      TEXT NOT NULL,
    interface TEXT NOT NULL,
    PRIMARY KEY (service, number)
) STRICT;

CREATE TABLE robots (
    name       TEXT PRIMARY KEY,
    owner      TEXT,
    first_seen INTEGER NOT NULL,
    last_seen  INTEGER NOT NULL
) STRICT;

CREATE TABLE servants (
    id        TEXT PRIMARY KEY,
    service   TEXT NOT NULL,
    revision  INTEGER NOT NULL,
    robot     TEXT NOT NULL,
    anonymous INTEGER NOT NULL,
    created   INTEGER NOT NULL
) STRICT;

CREATE TABLE events (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    time    INTEGER NOT NULL,
    level   TEXT NOT NULL,
    kind    TEXT NOT NULL,
    service TEXT,
    servant TEXT,
    robot   TEXT,
    message TEXT NOT NULL
) STRICT;
