CREATE TABLE rollouts (
    service TEXT PRIMARY KEY REFERENCES services (name) ON DELETE CASCADE,
    rollout TEXT NOT NULL
) STRICT;
