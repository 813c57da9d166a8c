-- Understood by SQLite and PostgreSQL alike.

-- The number of the job that must end before this one starts; NULL if it waits for none.
ALTER TABLE jobs ADD COLUMN after_job BIGINT;
