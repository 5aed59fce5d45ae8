-- Names of the topics that a file has messages of, as JSON: who may hear them all may have it. Of files of before nobody knows.
ALTER TABLE recordings ADD COLUMN topics TEXT;
