-- Which services there are events of, and the newest of some of them, without looking at all others.
CREATE INDEX events_service ON events (service, id);
