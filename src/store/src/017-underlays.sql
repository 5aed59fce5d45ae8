-- Compiled workspaces that services stand on; of each the newest, since an image has the layers that it was built with.
CREATE TABLE underlays (
    name      TEXT PRIMARY KEY,
    number    INTEGER NOT NULL,
    -- Keeps the layers.
    image     TEXT NOT NULL,
    published INTEGER NOT NULL,
    -- Absent if an operator published it first.
    owner     TEXT,
    source    TEXT NOT NULL,
    flavour   TEXT NOT NULL,
    -- Packages, layers and dependencies, as the builder describes them.
    contents  TEXT NOT NULL
) STRICT;
