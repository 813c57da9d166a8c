//! Trained models on disk: manifest, verification, loading.
