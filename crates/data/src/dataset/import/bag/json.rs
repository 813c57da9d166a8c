//! Commands and measurements in JSON: the messages of ROS 2 and a pose of Foxglove with the fields that bags give them, and the
//! numbers of any other object by their names. Errors: why a message cannot be read.

use serde::Deserialize;
use serde_json::Value;

use super::messages::{FieldValue, RosType, field, joint_fields, pose_fields, speed_fields};

/// The most numbers that an object of unknown type may have: a command or a state has few.
const MAX_NUMBERS: usize = 1000;

// Other fields are ignored: headers, coordinate frames, covariances, efforts.

#[derive(Deserialize)]
struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Deserialize)]
struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

#[derive(Deserialize)]
struct Twist {
    linear: Vector3,
    angular: Vector3,
}

/// A twist below a name: with a header, or with its covariance.
#[derive(Deserialize)]
struct NestedTwist {
    twist: Twist,
}

#[derive(Deserialize)]
struct Pose {
    position: Vector3,
    orientation: Quaternion,
}

/// A pose below a name: with its covariance, or in a coordinate frame.
#[derive(Deserialize)]
struct NestedPose {
    pose: Pose,
}

#[derive(Deserialize)]
struct Odometry {
    pose: NestedPose,
    twist: NestedTwist,
}

#[derive(Deserialize)]
struct JointState {
    name: Vec<String>,
    #[serde(default)]
    position: Vec<f64>,
    #[serde(default)]
    velocity: Vec<f64>,
}

impl Twist {
    fn fields(&self) -> Vec<FieldValue> {
        let Self { linear, angular } = self;
        speed_fields([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    }
}

impl Pose {
    fn fields(&self) -> Vec<FieldValue> {
        let Self { position, orientation } = self;
        let quaternion = [orientation.x, orientation.y, orientation.z, orientation.w];
        pose_fields([position.x, position.y, position.z], quaternion)
    }
}

/// The fields of a message of ROS 2 that is an action or a state.
pub(super) fn values(kind: RosType, message: &[u8]) -> Result<Vec<FieldValue>, String> {
    Ok(match kind {
        RosType::Odometry => {
            let Odometry { pose, twist } = read(message)?;
            [pose.pose.fields(), twist.twist.fields()].concat()
        }
        RosType::JointState => {
            let JointState {
                name,
                position,
                velocity,
            } = read(message)?;
            joint_fields(&name, position, velocity)
        }
        RosType::TwistStamped => read::<NestedTwist>(message)?.twist.fields(),
        _ => read::<Twist>(message)?.fields(),
    })
}

/// The fields of a `foxglove.PoseInFrame`.
pub(super) fn pose(message: &[u8]) -> Result<Vec<FieldValue>, String> {
    Ok(read::<NestedPose>(message)?.pose.fields())
}

/// The numbers of an object by their names, with dots: `wheels.left`, `wheels.0`. Their units are not known.
pub(super) fn numbers(message: &[u8]) -> Result<Vec<FieldValue>, String> {
    let mut fields = Vec::new();
    collect(&read::<Value>(message)?, "", &mut fields)?;
    Ok(fields)
}

fn collect(value: &Value, name: &str, fields: &mut Vec<FieldValue>) -> Result<(), String> {
    let below = |part: &str| {
        if name.is_empty() {
            part.to_owned()
        } else {
            format!("{name}.{part}")
        }
    };
    match value {
        Value::Object(members) => members
            .iter()
            .try_for_each(|(part, member)| collect(member, &below(part), fields)),
        Value::Array(items) => items
            .iter()
            .enumerate()
            .try_for_each(|(index, item)| collect(item, &below(&index.to_string()), fields)),
        Value::Number(_) if fields.len() == MAX_NUMBERS => Err(format!(
            "it has more than {MAX_NUMBERS} numbers; a command or a state has few"
        )),
        Value::Number(number) => {
            fields.extend(number.as_f64().map(|number| field(name.to_owned(), "", number)));
            Ok(())
        }
        _ => Ok(()),
    }
}

pub(super) fn read<'a, T: Deserialize<'a>>(message: &'a [u8]) -> Result<T, String> {
    serde_json::from_slice(message).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(fields: &[FieldValue], name: &str) -> f64 {
        fields.iter().find(|field| field.name == name).unwrap().value
    }

    #[test]
    fn messages_of_ros_have_the_fields_that_bags_give_them() {
        let twist = r#"{"linear":{"x":0.5,"y":0,"z":0},"angular":{"x":0,"y":0,"z":-0.25}}"#;
        for (kind, text) in [
            (RosType::Twist, twist.to_owned()),
            (RosType::TwistStamped, format!(r#"{{"header":{{}},"twist":{twist}}}"#)),
        ] {
            let fields = values(kind, text.as_bytes()).unwrap();
            let speeds = ["linear.x", "angular.z"].map(|name| named(&fields, name));
            assert_eq!((fields.len(), speeds), (6, [0.5, -0.25]), "{kind:?}");
        }
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let pose_text =
            format!(r#"{{"position":{{"x":1,"y":2,"z":0}},"orientation":{{"x":0,"y":0,"z":{half},"w":{half}}}}}"#);
        let text = format!(r#"{{"pose":{{"pose":{pose_text},"covariance":[]}},"twist":{{"twist":{twist}}}}}"#);
        let odometry = values(RosType::Odometry, text.as_bytes()).unwrap();
        let in_frame = pose(format!(r#"{{"frame_id":"map","pose":{pose_text}}}"#).as_bytes()).unwrap();
        for fields in [&odometry, &in_frame] {
            assert_eq!([named(fields, "x"), named(fields, "y")], [1.0, 2.0]);
            assert!(named(fields, "heading_cos").abs() < 1e-9 && (named(fields, "heading_sin") - 1.0).abs() < 1e-9);
        }
        assert_eq!(named(&odometry, "linear.x"), 0.5);
        let joints = br#"{"name":["left","right"],"velocity":[1.5,2.5]}"#;
        let joints = values(RosType::JointState, joints).unwrap();
        assert_eq!((joints.len(), named(&joints, "right.velocity")), (2, 2.5));
        for wrong in ["", "[]", r#"{"linear":{"x":0.5}}"#, r#"{"linear":1,"angular":2}"#] {
            assert!(values(RosType::Twist, wrong.as_bytes()).is_err(), "{wrong}");
        }
    }

    #[test]
    fn numbers_of_other_objects_have_their_names() {
        let fields = numbers(br#"{"speed":0.5,"wheels":{"left":1,"loads":[2,3]},"mode":"auto","on":true}"#).unwrap();
        let names: Vec<&str> = fields.iter().map(|field| &*field.name).collect();
        assert_eq!(names, ["speed", "wheels.left", "wheels.loads.0", "wheels.loads.1"]);
        assert_eq!(named(&fields, "wheels.loads.1"), 3.0);
        let many = format!("[{}0]", "0,".repeat(MAX_NUMBERS));
        assert!(numbers(many.as_bytes()).unwrap_err().contains("more than 1000 numbers"));
        assert!(numbers(&b"[".repeat(100_000)).is_err());
    }
}
