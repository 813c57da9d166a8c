//! Enums whose variant is named by a property: `oneOf` with a discriminator, each variant complete.

use std::collections::BTreeMap;

use serde_json::Value;
use utoipa::openapi::schema::{Discriminator, OneOf, Schema};
use utoipa::openapi::{OpenApi, Ref, RefOr};

/// A variant of an enum.
struct TaggedVariant {
    /// Where its schema is.
    location: String,
    /// The property that names it, with its schema.
    property: (String, RefOr<Schema>),
    /// Its value.
    value: String,
}

/// utoipa writes such an enum as `allOf` of the variant's fields and the property. A variant that allows no additional
/// properties then refuses the property, and every body with it. So the property moves into the variant.
pub(super) fn complete_variants(contract: &mut OpenApi) {
    let components = contract.components.get_or_insert_default();
    let mut found = Vec::new();
    for schema in components.schemas.values_mut() {
        if let RefOr::T(Schema::OneOf(union)) = schema
            && let Some(variants) = union.items.iter().map(TaggedVariant::of).collect::<Option<Vec<_>>>()
        {
            discriminate(union, &variants);
            found.extend(variants);
        }
    }
    for variant in found {
        let name = variant.location.rsplit('/').next().unwrap_or_default();
        if let Some(RefOr::T(Schema::Object(object))) = components.schemas.get_mut(name) {
            let (property, schema) = variant.property;
            object.required.insert(0, property.clone());
            object.properties.insert(property, schema);
        }
    }
}

impl TaggedVariant {
    /// The variant, if the schema is `allOf` of a reference and an object with one constant property.
    fn of(item: &RefOr<Schema>) -> Option<Self> {
        let RefOr::T(Schema::AllOf(all)) = item else {
            return None;
        };
        let [RefOr::Ref(reference), RefOr::T(Schema::Object(tag))] = all.items.as_slice() else {
            return None;
        };
        let mut properties = tag.properties.iter();
        let (Some((property, schema)), None) = (properties.next(), properties.next()) else {
            return None;
        };
        let RefOr::T(Schema::Object(values)) = schema else {
            return None;
        };
        let [Value::String(value)] = values.enum_values.as_deref()? else {
            return None;
        };
        Some(Self {
            location: reference.ref_location.clone(),
            property: (property.clone(), schema.clone()),
            value: value.clone(),
        })
    }
}

fn discriminate(union: &mut OneOf, variants: &[TaggedVariant]) {
    let Some(first) = variants.first() else { return };
    let mapping: BTreeMap<_, _> = variants
        .iter()
        .map(|variant| (variant.value.clone(), variant.location.clone()))
        .collect();
    union.discriminator = Some(Discriminator::with_mapping(first.property.0.clone(), mapping));
    let references = variants.iter().map(|variant| Ref::new(variant.location.clone()));
    union.items = references.map(RefOr::Ref).collect();
}
