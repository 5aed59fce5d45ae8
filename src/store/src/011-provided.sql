-- People whom an identity provider knows.
CREATE TABLE provided_people (
    id         INTEGER PRIMARY KEY AUTOINCREMENT,
    issuer     TEXT NOT NULL,
    -- By which the provider tells people apart, for ever.
    subject    TEXT NOT NULL,
    -- By which rules and records know the person: given once, and to nobody else.
    name       TEXT NOT NULL UNIQUE,
    created    INTEGER NOT NULL,
    last_login INTEGER NOT NULL,
    UNIQUE (issuer, subject)
) STRICT;

ALTER TABLE sessions ADD COLUMN person INTEGER REFERENCES provided_people (id);
-- Groups that the person had when it began, as JSON: those that the configuration named then.
ALTER TABLE sessions ADD COLUMN groups TEXT;
