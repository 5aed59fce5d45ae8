-- What servants and the machine did, sampled.
CREATE TABLE recorded (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    -- Empty: the machine.
    servant TEXT NOT NULL UNIQUE,
    service TEXT NOT NULL,
    robot   TEXT NOT NULL,
    began   INTEGER NOT NULL,
    -- When it was sampled last.
    seen    INTEGER NOT NULL
) STRICT;
CREATE INDEX recorded_robot ON recorded (robot);

CREATE TABLE samples (
    recorded INTEGER NOT NULL REFERENCES recorded (id) ON DELETE CASCADE,
    -- Seconds.
    step     INTEGER NOT NULL,
    time     INTEGER NOT NULL,
    -- Numbers of four bytes (IEEE 754, little-endian) in an order that is only ever added to; NaN: none.
    figures  BLOB NOT NULL,
    PRIMARY KEY (recorded, step, time)
) STRICT, WITHOUT ROWID;

-- When robots were served by their local originals.
CREATE TABLE local_periods (
    id      INTEGER PRIMARY KEY AUTOINCREMENT,
    service TEXT NOT NULL,
    robot   TEXT NOT NULL,
    node    TEXT NOT NULL,
    began   INTEGER NOT NULL,
    ended   INTEGER,
    why     TEXT NOT NULL
) STRICT;
CREATE INDEX local_periods_robot ON local_periods (robot, service);
