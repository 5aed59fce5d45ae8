CREATE TABLE audit (
    id     INTEGER PRIMARY KEY AUTOINCREMENT,
    time   INTEGER NOT NULL,
    who    TEXT NOT NULL,
    peer   TEXT NOT NULL,
    action TEXT NOT NULL,
    did    TEXT NOT NULL,
    object TEXT NOT NULL,
    status INTEGER NOT NULL,
    more   INTEGER NOT NULL
) STRICT;

CREATE TRIGGER audit_is_not_changed BEFORE UPDATE ON audit
BEGIN
    SELECT RAISE(ABORT, 'the audit log is only added to');
END;

-- What is older than the newest million may go, or the disk would fill.
CREATE TRIGGER audit_is_kept BEFORE DELETE ON audit
WHEN old.id > (SELECT seq FROM sqlite_sequence WHERE name = 'audit') - 1000000
BEGIN
    SELECT RAISE(ABORT, 'the audit log is only added to');
END;
