CREATE TABLE accounts (
    id         INTEGER PRIMARY KEY AUTOINCREMENT,
    name       TEXT NOT NULL,
    -- Argon2id in the PHC string format; empty once it is removed.
    password   TEXT NOT NULL,
    role       TEXT NOT NULL,
    scope      TEXT NOT NULL,
    created    INTEGER NOT NULL,
    last_login INTEGER,
    disabled   INTEGER,
    removed    INTEGER
) STRICT;

-- A name is one person's at a time.
CREATE UNIQUE INDEX live_accounts ON accounts (name) WHERE removed IS NULL;

CREATE TABLE sessions (
    id        INTEGER PRIMARY KEY AUTOINCREMENT,
    hash      TEXT NOT NULL UNIQUE,
    -- None: a provider says who it is, and role and scope are the session's own.
    account   INTEGER REFERENCES accounts (id),
    name      TEXT NOT NULL,
    role      TEXT NOT NULL,
    scope     TEXT NOT NULL,
    peer      TEXT NOT NULL,
    created   INTEGER NOT NULL,
    last_used INTEGER NOT NULL,
    expires   INTEGER NOT NULL
) STRICT;
