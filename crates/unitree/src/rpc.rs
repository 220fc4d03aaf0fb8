//! Requests to the robot's services and their responses (IDL module `unitree_api`).

use crate::cdr::{FieldVisitor, Message};

/// Request to a service, on `rt/api/<service>/request`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RpcRequest {
    /// Number of the request; its response has the same.
    pub id: i64,
    /// Number of the procedure.
    pub api_id: i64,
    /// Lease of the service; 0 for none.
    pub lease_id: i64,
    /// Priority.
    pub priority: i32,
    /// 1 if no response is needed.
    pub noreply: u8,
    /// Arguments as JSON.
    pub parameter: String,
    /// Further arguments.
    pub binary: Vec<u8>,
}

/// Response of a service, on `rt/api/<service>/response`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RpcResponse {
    /// Number of the request.
    pub id: i64,
    /// Number of the procedure.
    pub api_id: i64,
    /// Error code; 0 for success.
    pub code: i32,
    /// Result as JSON.
    pub data: String,
    /// Further results.
    pub binary: Vec<u8>,
}

impl Message for RpcRequest {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.id);
        fields.value(&mut self.api_id);
        fields.value(&mut self.lease_id);
        fields.value(&mut self.priority);
        fields.value(&mut self.noreply);
        fields.string(&mut self.parameter);
        fields.bytes(&mut self.binary);
    }
}

impl Message for RpcResponse {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.id);
        fields.value(&mut self.api_id);
        fields.value(&mut self.code);
        fields.string(&mut self.data);
        fields.bytes(&mut self.binary);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::{decode, encode};

    #[test]
    fn request_and_response_round_trip() {
        let request =
            RpcRequest { id: 7, api_id: 1001, parameter: "{}".to_owned(), noreply: 1, ..RpcRequest::default() };
        let payload = encode(&request);
        // Three numbers of eight bytes, priority, noreply, three bytes of padding; then the string's length.
        assert_eq!(payload[4 + 32..4 + 40], [3, 0, 0, 0, b'{', b'}', 0, 0]);
        assert_eq!(decode(&payload), Ok(request));
        let data = r#"{"form":"0","name":""}"#.to_owned();
        let response = RpcResponse { id: 7, api_id: 1001, code: 3104, data, binary: vec![1, 2] };
        assert_eq!(decode(&encode(&response)), Ok(response));
    }
}
