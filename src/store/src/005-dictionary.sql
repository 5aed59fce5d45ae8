CREATE TABLE dictionary (
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    service  TEXT NOT NULL REFERENCES services (name) ON DELETE CASCADE,
    measure  TEXT NOT NULL,
    value    REAL NOT NULL,
    aux      TEXT NOT NULL,
    limits   TEXT NOT NULL,
    spread   TEXT,
    revision INTEGER,
    written  INTEGER NOT NULL,
    UNIQUE (service, measure, value, aux)
) STRICT;
