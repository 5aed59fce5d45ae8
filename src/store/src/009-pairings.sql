CREATE TABLE pairing_codes (
    id        INTEGER PRIMARY KEY AUTOINCREMENT,
    robot     TEXT NOT NULL,
    hash      TEXT NOT NULL UNIQUE,
    scope     TEXT NOT NULL,
    created   INTEGER NOT NULL,
    expires   INTEGER NOT NULL,
    used      INTEGER,
    cancelled INTEGER
) STRICT;

-- A robot has one code at a time that could be used.
CREATE UNIQUE INDEX live_pairing_codes ON pairing_codes (robot) WHERE used IS NULL AND cancelled IS NULL;

CREATE TABLE pairings (
    id        INTEGER PRIMARY KEY AUTOINCREMENT,
    robot     TEXT NOT NULL,
    scope     TEXT NOT NULL,
    -- SHA-256 of the robot's key; NULL where another authority signs its certificates.
    key       TEXT,
    created   INTEGER NOT NULL,
    -- The end of its newest certificate.
    expires   INTEGER,
    last_used INTEGER,
    revoked   INTEGER
) STRICT;

CREATE UNIQUE INDEX live_pairings ON pairings (robot) WHERE revoked IS NULL;
