// Who looks at this page, by its address.

export const isInstructor = location.pathname.endsWith('/instructor');
export const role = isInstructor ? 'instructor' : 'trainee';
export const socketPath = isInstructor ? 'instructor/session' : 'session'; // beside the page
