-- Files in HOME/recordings, which are named by their numbers.
CREATE TABLE recordings (
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    service  TEXT NOT NULL,
    robot    TEXT NOT NULL,
    servant  TEXT NOT NULL,
    time     INTEGER NOT NULL,
    why      TEXT NOT NULL,
    -- Milliseconds.
    span     INTEGER NOT NULL,
    messages INTEGER NOT NULL,
    bytes    INTEGER NOT NULL
) STRICT;
CREATE INDEX recordings_robot ON recordings (robot);
