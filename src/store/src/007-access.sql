CREATE TABLE tokens (
    id        INTEGER PRIMARY KEY AUTOINCREMENT,
    name      TEXT NOT NULL,
    hash      TEXT NOT NULL UNIQUE,
    role      TEXT NOT NULL,
    scope     TEXT NOT NULL,
    created   INTEGER NOT NULL,
    expires   INTEGER,
    last_used INTEGER,
    revoked   INTEGER
) STRICT;

-- A name is one principal's at a time.
CREATE UNIQUE INDEX live_tokens ON tokens (name) WHERE revoked IS NULL;

CREATE TABLE rules (
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    who      TEXT NOT NULL,
    services TEXT NOT NULL,
    allow    TEXT NOT NULL
) STRICT;

INSERT INTO rules (who, services, allow) VALUES
    ('role:robot', '*', '["*:**"]'),
    ('role:deployer', '*', '["*:**"]');

ALTER TABLE services ADD COLUMN owner TEXT;
