ALTER TABLE revisions ADD COLUMN flavour TEXT;
ALTER TABLE revisions ADD COLUMN inventory TEXT;
